"""Quick verbs: tool, base and hand-eye calibration, the arm's geometry left as it is."""

OFFERS = {"commands": "commands:app"}
