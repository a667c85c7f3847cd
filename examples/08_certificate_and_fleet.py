"""Calibrate a fleet: a session per robot, run as far as they go; certificate and calibrated files at the end.

python examples/08_certificate_and_fleet.py [FOLDER]
"""

import sys
from pathlib import Path

from calib.procedure.session import demo, fleet
from calib.procedure.session.commands import begin

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "example-08")

# a session is a folder; `calib new` makes one, too. Here two robots of a kind that differ by their seed
sessions = [begin(folder / f"cell{k}", "ur5", "cmm", poses=20, validation=8, seed=k, dynamics=False) for k in (1, 2)]
folders = [session.folder for session in sessions]
for _ in range(2):
    for outcome in fleet.run(folders, map, "08_certificate_and_fleet.py"):
        print(f"{outcome.folder}: {outcome.state}, {outcome.verdict or outcome.words}")
    for session in sessions:  # yours: copy the measured files into 3-measured; here the simulated cells bring them
        if not any(session.path("3-measured").glob("measured.csv")):
            demo.bring_for(session, "measure", print)

for session in sessions:
    print(f"{session.path('certificate.html')} and, for robots and simulators, {session.path(session.export)}:")
    print("  " + ", ".join(sorted(path.name for path in session.path(session.export).iterdir())))
