"""Experiment design for geometry: observability indices and selection of measurement poses, without robot classes."""
