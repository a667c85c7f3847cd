"""Simulation of recordings' closed loops: controllers, instrumental variables, test of least squares for bias.

Also the tracking error with the identified model as feedforward. Settings and results are records of the core, see
`calib.identification.loop`.
"""

OFFERS = {"methods": "simulated:METHODS", "loop_results": "simulated:loop_results", "track": "replay:track"}
