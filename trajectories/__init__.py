"""Experiment design for dynamics: exciting motions within limits, from arrays and callables (no robot classes)."""
