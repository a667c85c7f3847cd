"""Plan the fastest motion through waypoints, on the identified model: its torques, its friction, its uncertainty.

python examples/07_plan_on_identified_model.py [FOLDER]
"""

from pathlib import Path

import practice

import calib

practice.enter(__file__)
practice.record("training.csv", motion=1)
Path("waypoints.csv").write_text("""q1,q2,q3,q4,q5,q6
0.0,0.3,1.2,0.0,0.5,0.0
1.2,0.8,0.6,0.5,0.9,0.8
0.4,0.2,1.5,-0.5,0.2,-0.6
""")

nominal_motion = calib.plan_motion("tx40", "waypoints.csv")
model = calib.identify_dynamics("tx40", "training.csv", friction="standard")
motion = calib.plan_motion("tx40", "waypoints.csv", model=model)
print(f"on the maker's model: {nominal_motion.duration:.3f} s")
print(f"on the identified model: {motion.duration:.3f} s")
motion.save("motion")  # motion.csv, trajectory.yaml for ROS 2, plots
