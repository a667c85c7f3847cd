"""Joint commands that move the tool of the calibrated robot to nominal targets."""

OFFERS = {"commands": "commands:app", "topics": ":TOPICS"}
TOPICS = {
    "targets": (
        "targets of calib compensate, and the commands it writes",
        "calib.data.poses.pose_lists calib.rooms.compensation.joint_commands calib.rooms.compensation.programs "
        "calib.rooms.compensation.program_frames "
        "calib.apps.controller_programs.languages calib.apps.controller_programs.configurations",
    )
}
