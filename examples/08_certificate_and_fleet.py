"""Calibrate a fleet: a session per robot, run as far as they go; certificate and calibrated files at the end.

python examples/08_certificate_and_fleet.py [FOLDER]
"""

import practice

import calib

practice.enter(__file__)

# two robots of a kind; `calib new cell1 --robot ur5 --instrument cmm --geometry-only` makes such a folder, too
counts = {"poses": 20, "validation": 8}
cell1 = calib.new_session("cell1", "ur5", "cmm", seed=1, dynamics=False, **counts)
cell2 = calib.new_session("cell2", "ur5", "cmm", seed=2, dynamics=False, **counts)
for _ in range(2):
    for outcome in calib.run_sessions([cell1, cell2]):
        print(outcome)
        if outcome.state == "waits":  # yours: copy the measured files into 3-measured
            practice.bring(outcome.folder)

for cell in (cell1, cell2):
    print(f"{cell / 'certificate.html'} and, for robots and simulators, {cell / '6-export'}:")
    names = sorted(path.name for path in (cell / "6-export").iterdir())
    print("  " + ", ".join(names))
