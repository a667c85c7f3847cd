"""Closed-loop mechanisms: models of parallel and redundantly actuated robots for identification and calibration.

`parallel_robot` describes such a robot and reads its TOML file; `closure` solves the loops, `velocities`
differentiates them; `parallel_model` is the regressor.
"""
