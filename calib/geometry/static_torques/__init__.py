"""Torques at rest: gravity learnt from the joints' sensors, payloads found by it, torques that drive the compliance."""
