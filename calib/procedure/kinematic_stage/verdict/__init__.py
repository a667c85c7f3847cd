"""Errors of a fit on fitted and unseen rows, findings on them, and the verdict that follows."""
