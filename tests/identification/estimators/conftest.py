"""Fixtures of the planted arm."""

from planted_motion import problem, robot

__all__ = ["problem", "robot"]
