"""Fit a robot's geometry to measured poses in a CSV file, and validate it on held-out poses.

python examples/01_fit_geometry.py [FOLDER]
"""

import practice

import calib

practice.enter(__file__)
practice.measure("measured.csv")  # yours comes from the tracker: joints and pose, a row each

fit = calib.fit_geometry("ur5", "measured.csv", calib.FitSettings(model="geometry", holdout=0.25))
print(fit)
fit.save("fit")  # robot.urdf, estimate.csv, certificate.html …
