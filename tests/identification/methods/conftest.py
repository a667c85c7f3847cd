"""A problem of identification on the planted arm, for every method."""

from planted_motion import problem

__all__ = ["problem"]
