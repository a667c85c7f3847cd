"""What a process has loaded at each of some stages: the command line, the API, its options, a fit, an options file."""

import json
import subprocess
import sys
from pathlib import Path

from calib.robot.chain import random_joints
from calib.robot.library import load
from calib.simulation.cell import measure, write_measured
from calib.simulation.virtual_cells import perturbed_cell

CODE = """
import json, sys
loaded = {}
def note(stage):
    loaded[stage] = sorted(sys.modules)
import calib.cli
note("command line")
import calib.api.kinematic
note("geometry")
import calib.data.poses.fit_options as f, calib.identification.identify_options as i
f.read_options(), i.read_options()
note("no options file")
words = ["fit", "ur5", "measured.csv", "--model", "geometry", "--out", "o"]
assert calib.cli.run(words) == 0
note("fit")
f.parse_options({})
note("options file")
print(json.dumps(loaded))
"""


def stages(folder: Path) -> dict[str, set[str]]:
    """Return the modules loaded at each stage of one process that works in a folder."""
    cell = perturbed_cell(load("ur5"), seed=1)
    write_measured(measure(cell, random_joints(cell.nominal, 40, 0), 1), folder / "measured.csv")
    process = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True, cwd=folder)
    last_line = process.stdout.splitlines()[-1]
    return {stage: set(names) for stage, names in json.loads(last_line).items()}
