"""Virtual cells, whose truth is known: robots, instruments and errors for demonstrations, studies and tests."""

OFFERS = {"commands": "commands:app"}
