"""Searches that move joint values continuously: local ones, from several starts, and the two-stage meta-heuristic."""
