"""Identified dynamics that learn from further logs."""
