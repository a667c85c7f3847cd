"""Fixtures of the planted arm."""

from planted_files import robot

__all__ = ["robot"]
