"""Demonstration: a simulated cell calibrated like a real one, and compared with the hidden truth."""

OFFERS = {"commands": "commands:app"}
