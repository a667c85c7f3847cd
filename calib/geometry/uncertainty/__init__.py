"""Uncertainty of a fitted arm: covariance of its parameters, and expected errors at any pose."""
