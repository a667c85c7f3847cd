"""Design a motion that shows a robot's dynamics, within its limits.

python examples/05_design_excitation.py [FOLDER]
"""

import sys
from pathlib import Path

from calib.procedure.excitation import design, design_folder
from calib.procedure.report import motion_figures

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "example-05")

# little effort, to be quick: the defaults search longer and reach better condition numbers
designed = design.excite("tx40", period=8.0, starts=1, evaluations=40, samples=100, seed=0)
design_folder.write_folder(designed, folder, motion_figures.write_design)

for line in design_folder.lines(designed):
    print(line)
print(f"trajectory.csv, for ROS 2 trajectory.yaml, and plots are in {folder}")
