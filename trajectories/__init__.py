"""Experiment design for dynamics: exciting motions within a robot's limits. Knows no robot: arrays and callables."""
