"""Compute the joint commands that bring the real tool to nominal targets, and check its true position.

python examples/04_compensate.py [FOLDER]
"""

import practice

import calib

practice.enter(__file__)
practice.measure("measured.csv")
practice.teach("targets.csv")  # yours: where the tool is to stand, and the joints near which

fit = calib.fit_geometry("ur5", "measured.csv", calib.FitSettings(model="geometry", holdout=0.25))
commands = calib.compensate(fit, "targets.csv", frame="measured", tool="tool")
print(commands)
commands.save("commands.csv")

for name, q in (("nominal joints", commands.nominal), ("commands", commands.q)):
    print(f"{name}: the real tool is off by {practice.target_error(q):.3f} mm rms")
