"""Command that writes a certificate again: calib certificate."""

OFFERS = {"commands": "commands:app"}
