"""A page of a session on this machine's network, for the engineer at the robot: `calib serve`."""

OFFERS = {"commands": "commands:app"}
