"""Identify a robot's dynamics from a recording, and validate the model on another motion.

python examples/06_identify_dynamics.py [FOLDER]
"""

import practice

import calib

practice.enter(__file__)
practice.record("training.csv", motion=1)  # yours come from the controller: time, positions, torques or currents
practice.record("other.csv", motion=2)

model = calib.identify_dynamics("tx40", "training.csv", validate="other.csv", friction="standard")
print(model)
model.save("model")  # base parameters with covariance, certificate.html, plots
