"""Uncertainty of an identified model, including the contribution of the geometry."""
