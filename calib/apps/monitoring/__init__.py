"""A robot over time: comparison of two calibrations, drift during a measurement, and a log of all calibrations."""

OFFERS = {"commands": "commands:app"}
