"""Plan the fastest motion through waypoints, on the identified model: its torques, its friction, its uncertainty.

python examples/07_plan_on_identified_model.py [FOLDER]
"""

import sys
from pathlib import Path

from calib.data.poses.plans import write_poses
from calib.procedure.dynamic_stage import folder as identification_outputs
from calib.procedure.dynamic_stage import identify
from calib.procedure.dynamic_stage.inputs import gather
from calib.procedure.excitation import folder as motion_folder
from calib.procedure.excitation import planning
from calib.procedure.report import motion_figures
from calib.robot.load import load
from calib.simulation.cells import measured_files
from calib.simulation.cells.virtual_arm import moving_arm, record
from calib.simulation.cells.virtual_cells import virtual_cell
from calib.simulation.loop.references import random_fourier

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "example-07")
folder.mkdir(parents=True, exist_ok=True)

# an identified model, as in example 06
arm, chain = moving_arm(virtual_cell("tx40", 0), "tx40", 0), load("tx40")
speeds = [0.5 * joint.velocity for joint in chain.joints]
reference = random_fourier(chain.lower, chain.upper, speeds, 10.0, 500.0, acceleration=15.0, seed=1)
measured_files.write_log(record(arm, reference, 1), folder / "training.csv")
inputs = gather("tx40", [str(folder / "training.csv")], friction="standard")
identification_outputs.write_folder(identify.run(inputs), folder / "model")

corners = [[0.0, 0.3, 1.2, 0.0, 0.5, 0.0], [1.2, 0.8, 0.6, 0.5, 0.9, 0.8], [0.4, 0.2, 1.5, -0.5, 0.2, -0.6]]
write_poses(folder / "waypoints.csv", corners, chain.joint_names)
for words, model in (("the maker's model", None), ("the identified model", folder / "model")):
    planned = planning.plan("tx40", folder / "waypoints.csv", model=model)
    print(f"on {words}: {planned.track.duration:.3f} s")
motion_folder.write_plan(planned, folder / "motion", motion_figures.write_plan)
print(f"motion.csv and trajectory.yaml are in {folder / 'motion'}")
