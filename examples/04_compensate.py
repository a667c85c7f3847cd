"""Turn nominal targets into the joint commands that put the real tool there, and see where it really stands.

python examples/04_compensate.py [FOLDER]
"""

import sys
from pathlib import Path

import numpy as np

from calib.data.poses.target_files import Targets
from calib.procedure.kinematic_stage import compensation, fit, inputs
from calib.procedure.kinematic_stage import folder as outputs
from calib.procedure.kinematic_stage.settings import FitSettings
from calib.robot.load import load
from calib.simulation.cells import measured_files
from calib.simulation.cells.cell import measure, true_poses
from calib.simulation.cells.virtual_cells import perturbed_cell

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "example-04")
folder.mkdir(parents=True, exist_ok=True)

# a calibrated robot, as in example 01
cell = perturbed_cell(load("ur5"), seed=1)
q = np.random.default_rng(0).uniform(-2.0, 2.0, (80, 6))
measured_files.write(measure(cell, q, seed=2), folder / "measured.csv")
found = inputs.gather("ur5", [folder / "measured.csv"], settings=FitSettings(model="geometry", holdout=0.25))
outputs.write_folder(fit.run(found, wanted=FitSettings(model="geometry")), folder / "fit")

# targets: places of the measured tool in the instrument's frame, and the configuration to reach them in
near = np.array([0.3, -1.2, 1.6, -1.1, -1.4, 0.5]) + np.random.default_rng(3).uniform(-0.4, 0.4, (50, 6))
wanted = true_poses(cell, near)
targets = Targets(near, wanted[:, :3, 3], wanted[:, :3, :3])
commands = compensation.compensate(compensation.read(folder / "fit"), targets, frame="measured", tool="tool")

for words, joints in (("nominal joints", commands.nominal), ("commands", commands.q)):
    off = np.linalg.norm(true_poses(cell, joints)[:, :3, 3] - wanted[:, :3, 3], axis=1)
    print(f"{words}: the real tool is off by {1e3 * np.sqrt(np.mean(off**2)):.3f} mm rms")
print(f"{int(commands.reached.sum())} of {len(commands.q)} reached; {commands.notes[0]}")
