"""Experiment design for geometry: observability indices and the selection of measurement poses. No robot classes."""
