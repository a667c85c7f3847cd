"""Identify a robot's dynamics from a recording, and see how well it predicts another motion.

python examples/06_identify_dynamics.py [FOLDER]
"""

import sys
from pathlib import Path

from calib.procedure.dynamic_stage import folder as identification_outputs
from calib.procedure.dynamic_stage import identify
from calib.procedure.dynamic_stage.inputs import gather
from calib.robot.load import load
from calib.simulation.cells import measured_files
from calib.simulation.cells.virtual_arm import moving_arm, record
from calib.simulation.cells.virtual_cells import virtual_cell
from calib.simulation.loop.references import random_fourier

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "example-06")
folder.mkdir(parents=True, exist_ok=True)

# yours: logs of q and torque (or current) of an excitation and of another motion; here a simulated TX40
arm = moving_arm(virtual_cell("tx40", 0), "tx40", 0)
chain = load("tx40")
for name, seed in (("training", 1), ("other", 2)):
    speeds = [0.5 * joint.velocity for joint in chain.joints]
    reference = random_fourier(chain.lower, chain.upper, speeds, 10.0, 500.0, acceleration=15.0, seed=seed)
    measured_files.write_log(record(arm, reference, seed), folder / f"{name}.csv")

inputs = gather("tx40", [str(folder / "training.csv")], [str(folder / "other.csv")], friction="standard")
outcome = identify.run(inputs)
identification_outputs.write_folder(outcome, folder / "model")
for name, score in outcome.validation.items():
    print(f"{name}, unseen: {score.raw.total:.1f} % of the torque unexplained")
print(f"{outcome.verdict.level}: {outcome.verdict.reason}")
