"""Fixtures of the planted arm."""

from planted_motion import robot

__all__ = ["robot"]
