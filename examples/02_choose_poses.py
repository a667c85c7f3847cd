"""Choose the poses at which a robot's geometry shows best, under its joint limits, and compare with random ones.

python examples/02_choose_poses.py [FOLDER]
"""

import sys
from pathlib import Path

from calib.procedure.kinematic_stage import selection
from calib.procedure.kinematic_stage.settings import SelectionSettings

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "example-02")
folder.mkdir(parents=True, exist_ok=True)

# from a tracker that sees one reflector at a time: three of them on the tool tell its orientation, too
targets = [[0.05, 0.0, 0.1], [-0.05, 0.0, 0.1], [0.0, 0.05, 0.15]]
settings = SelectionSettings(kind="position", tools=targets, candidates=500)
chosen = selection.choose("ur5", 20, settings)

for words, number in selection.table(chosen):
    print(f"{words:38} {number}")
selection.write(chosen, folder / "poses.csv")
print(f"written to {folder / 'poses.csv'}: joint values in rad, for the robot program")
