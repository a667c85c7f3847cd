"""Fleets: many sessions side by side, one folder per robot."""

OFFERS = {"commands": "commands:app"}
