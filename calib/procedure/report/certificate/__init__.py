"""Calibration certificates of at most four pages (HTML, PDF), and complete reports, for sessions and single results."""
