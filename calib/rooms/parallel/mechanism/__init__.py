"""Closed loops: parallel and actuation-redundant robots as models that are identified and calibrated like any other.

`parallel_robot` says what such a robot is, `parallel_files` is its TOML; `closure` solves the loops, `velocities`
differentiates them; `parallel_model` is the regressor.
"""
