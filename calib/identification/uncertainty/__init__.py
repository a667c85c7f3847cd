"""Uncertainty of an identification: contribution of the geometry, and intervals of predicted torques."""
