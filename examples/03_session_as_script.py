"""A guided session as a script: `calib demo` line by line, a simulated cell standing for yours.

python examples/03_session_as_script.py --out session [--robot lwr4plus] [--seed 0]
"""

import argparse
from pathlib import Path

from calib.procedure.session import demo, instructions, steps
from calib.procedure.session.commands import begin
from calib.procedure.session.folder import locked, verdict_of

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--out", type=Path, required=True)
parser.add_argument("--robot", default="lwr4plus")
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--geometry-only", action="store_true")
given = parser.parse_args()

session = begin(
    given.out, given.robot, "cmm", poses=40, validation=20, seed=given.seed, dynamics=not given.geometry_only,
    period=10.0, starts=2, evaluations=150, repeats=2, torques="both",
)  # fmt: skip
with locked(session):
    while waiting := steps.run_next(session, print, lambda words: None, "03_session_as_script.py"):
        print(*instructions.asks(session, waiting), sep="\n")  # what an engineer would now do at the robot, and bring
        demo.bring_for(session, waiting.step.name, print)  # your script would copy files into 3-measured, 7-recorded
print(f"{verdict_of(session)}: {session.path('certificate.html')}, {session.path(session.export) / 'robot.urdf'}")
