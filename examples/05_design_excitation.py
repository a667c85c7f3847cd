"""Design a motion that shows a robot's dynamics, within its limits.

python examples/05_design_excitation.py [FOLDER]
"""

import sys
from pathlib import Path

from calib.procedure.excitation import design
from calib.procedure.excitation import folder as motion_folder
from calib.procedure.excitation.settings import ExcitationSettings
from calib.procedure.report import motion_figures

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "example-05")

# little effort, to be quick: the defaults search longer and reach better condition numbers
settings = ExcitationSettings(period=8.0, starts=1, evaluations=40, samples=100)
designed = design.excite("tx40", settings)
motion_folder.write_design(designed, folder, motion_figures.write_design)

for line in motion_folder.design_lines(designed):
    print(line)
print(f"trajectory.csv, for ROS 2 trajectory.yaml, and plots are in {folder}")
