"""Command that opens the documentation built in a clone of the project."""

OFFERS = {"commands": "commands:app"}
