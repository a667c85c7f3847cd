"""Closed-loop mechanisms: models of parallel and redundantly actuated robots for identification and calibration.

`parallel_robot` says what such a robot is, `parallel_files` is its TOML; `closure` solves the loops, `velocities`
differentiates them; `parallel_model` is the regressor.
"""
