"""A guided session as a script: geometry, then dynamics, a simulated cell standing for yours.

python examples/03_session_as_script.py [FOLDER]
"""

import practice

import calib

practice.enter(__file__)

# little effort for the motions, to be quick: the defaults search longer
quick_search = {"period": 6.0, "starts": 1, "evaluations": 100, "repeats": 2}
session = calib.new_session("cell7", "lwr4plus", "cmm", poses=40, validation=20, torques="both", **quick_search)

outcome = next(calib.run_sessions(session))
while outcome.state == "waits":
    print(outcome)  # what an engineer would now do at the robot, and into which folder the files go
    practice.bring(session)
    outcome = next(calib.run_sessions(session))
print(outcome)
print(f"{outcome.verdict}: {session / 'certificate.html'}")
