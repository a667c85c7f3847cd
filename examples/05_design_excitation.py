"""Design a motion that excites a robot's dynamics, within its limits.

python examples/05_design_excitation.py [FOLDER]
"""

import practice

import calib

practice.enter(__file__)

# little effort, to be quick: the defaults search longer and reach better condition numbers
settings = calib.ExcitationSettings(period=8.0, starts=1, evaluations=40, samples=100)
motion = calib.design_excitation("tx40", settings)
print(motion)
motion.save("motion")  # trajectory.csv, trajectory.yaml for ROS 2, plots
