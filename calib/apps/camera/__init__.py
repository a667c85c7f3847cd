"""Commands for boards and images: calib board, calib images."""

OFFERS = {"commands": "commands:app"}
