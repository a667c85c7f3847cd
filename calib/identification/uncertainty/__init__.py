"""Uncertainty of an identification: the share of the geometry, and intervals of predicted torques."""
