"""Joint commands that move the tool of the calibrated robot to nominal targets."""

OFFERS = {"commands": "commands:app", "formats": ":FORMATS"}
FORMATS = {
    "targets": (
        "targets of calib compensate, and the commands it writes",
        "calib.data.poses.pose_lists calib.apps.compensation.joint_commands calib.apps.compensation.programs "
        "calib.apps.compensation.program_frames "
        "calib.apps.controller_programs.languages calib.apps.controller_programs.configurations",
        "",
    )
}
