"""Implementation of the Python API: functions for the stages of a calibration, and result classes with console
output.
"""
