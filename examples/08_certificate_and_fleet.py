"""Calibrate a fleet: a session per robot, run as far as they go; certificate and calibrated files at the end.

python examples/08_certificate_and_fleet.py [FOLDER]
"""

import practice

import calib

practice.enter(__file__)

# two robots of a kind; `calib new cell1 --robot ur5 --instrument cmm --geometry-only` makes such a folder, too
cells = [calib.new_session(f"cell{k}", "ur5", "cmm", poses=20, validation=8, seed=k, dynamics=False) for k in (1, 2)]
for _ in range(2):
    for now in calib.run_sessions(cells):
        print(now)
        if now.state == "waits":  # yours: copy the measured files into 3-measured
            practice.bring(now.folder)

for cell in cells:
    print(f"{cell / 'certificate.html'} and, for robots and simulators, {cell / '6-export'}:")
    print("  " + ", ".join(sorted(path.name for path in (cell / "6-export").iterdir())))
