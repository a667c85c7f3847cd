"""Simulation of the closed loop of recordings: controllers, instrumental variables, test of least squares for bias.

Settings and results are in `calib.identification.loop`.
"""
