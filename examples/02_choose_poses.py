"""Choose the best poses to identify a robot's geometry, within its joint limits; compare with random poses.

python examples/02_choose_poses.py [FOLDER]
"""

import practice

import calib

practice.enter(__file__)

# a tracker sees one reflector at a time: three of them on the tool show its orientation, too
reflectors = ((0.05, 0.0, 0.1), (-0.05, 0.0, 0.1), (0.0, 0.05, 0.15))
settings = calib.SelectionSettings(kind="position", tools=reflectors, index="O1", candidates=500)
plan = calib.select_poses("ur5", 20, settings)
print(plan)
plan.save("poses.csv")  # joint values in rad, for the robot program
