"""A robot over time: two calibrations compared, drift during a measurement, the log of a robot's certificates."""

OFFERS = {"commands": "commands:app"}
