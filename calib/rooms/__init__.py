"""Rooms that can be shut: parts of the toolkit that the core does without (`calib.extensions`)."""
