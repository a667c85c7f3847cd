"""Implementation of the Python API: functions for the stages, and results that print themselves."""
