"""Checks of measurements by what a rigid arm leaves: what changed while measuring, readings that are none."""
