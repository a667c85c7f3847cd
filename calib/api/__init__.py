"""Implementation of the Python API: functions for the stages of a calibration, and classes of results."""
