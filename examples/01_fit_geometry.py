"""Fit a robot's geometry to measured poses in a CSV file, and judge it on poses it has not seen.

python examples/01_fit_geometry.py [FOLDER]
"""

import sys
from pathlib import Path

import numpy as np

from calib.procedure.kinematic_stage import fit, inputs
from calib.procedure.kinematic_stage import folder as outputs
from calib.procedure.kinematic_stage.settings import FitSettings
from calib.robot.load import load
from calib.simulation.cells import measured_files
from calib.simulation.cells.cell import measure
from calib.simulation.cells.virtual_cells import perturbed_cell

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "example-01")
folder.mkdir(parents=True, exist_ok=True)

# yours: a CSV from the tracker; here a UR5 whose true geometry is a little off its nominal one
cell = perturbed_cell(load("ur5"), seed=1)
q = np.random.default_rng(0).uniform(-2.0, 2.0, (80, cell.nominal.n))
measured_files.write(measure(cell, q, seed=2), folder / "measured.csv")

found = inputs.gather("ur5", [folder / "measured.csv"], settings=FitSettings(model="geometry", holdout=0.25))
outcome = fit.run(found, wanted=FitSettings(model="geometry"))
outputs.write_folder(outcome, folder / "fit")

for name, unseen in outcome.validation.items():
    for arm, errors in zip(("nominal", "calibrated"), unseen.errors):
        print(f"{name}, {unseen.poses} unseen poses, {arm}: {1e3 * np.sqrt(np.mean(errors.position**2)):.3f} mm rms")
print(f"{outcome.verdict.level}: {outcome.verdict.reason}")
for line in outcome.unclear[:3]:
    print(f"cannot be told: {line}")
