"""Optional packages of the toolkit: the core works without them (`calib.extensions`)."""
