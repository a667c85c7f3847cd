"""Display of robot, errors, poses, motions and torques in Rerun."""

OFFERS = {"commands": "commands:app", "recordings": "viewer:write_beside"}
