"""Web page of a session on the local network, for the engineer at the robot: `calib serve`."""

OFFERS = {"commands": "commands:app"}
