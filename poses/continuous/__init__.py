"""Searches that move joint values continuously: local search, multistart, and the two-stage meta-heuristic."""
