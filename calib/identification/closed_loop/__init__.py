"""Simulation of recordings' closed loops: controllers, instrumental variables, test of least squares for bias.

Settings and results: `calib.identification.loop`.
"""
