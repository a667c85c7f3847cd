"""Robot controllers: programs of poses for them, targets inside their programs, their logs; what each can be told."""

OFFERS = {
    "commands": "commands:app",
    "exports": "logs:translated",
    "read_bag": "bags:read_bag",
    "topics": ":TOPICS",
    "check_controller": "table:check_controller",
    "joint_origins": "joint_origins:joint_origins",
    "ur_kinematics": "ur_kinematics:kinematics",
    "write_program": "program:write_program",
    "as_described": "table:as_described",
    "motors_as_described": "table:motors_as_described",
}
TOPICS = {
    "programs": (
        "programs for robot controllers, of calib program",
        "calib.rooms.controllers.program calib.rooms.controllers.motion "
        "calib.rooms.controllers.targets calib.rooms.controllers.table",
    ),
    "frames": ("controllers' base and flange frames, of calib deliver and programs", "calib.rooms.controllers.frames"),
    "logs": (
        "logs of robot controllers, by brand, and ROS bags",
        "calib.rooms.controllers.logs calib.rooms.controllers.bags",
    ),
}
