"""Experiment design for dynamics: exciting motions within limits, from arrays and callables, without robot classes."""
