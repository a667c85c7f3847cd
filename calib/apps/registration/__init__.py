"""Quick commands: tool, base and hand-eye calibration, without changing the arm's geometry."""

OFFERS = {"commands": "commands:app"}
