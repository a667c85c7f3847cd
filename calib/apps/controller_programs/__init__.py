"""Programs for robot controllers: written from lists of poses, and read for the targets in them."""

OFFERS = {"commands": "commands:app", "formats": ":FORMATS", "write_program": "program:write_program"}
FORMATS = {
    "programs": (
        "programs for robot controllers, of calib program",
        "calib.apps.controller_programs.program calib.apps.controller_programs.motion_streams "
        "calib.apps.controller_programs.targets calib.controllers.table",
        "",
    ),
    "frames": (
        "controllers' base and flange frames, of calib deliver and programs",
        "calib.apps.controller_programs.frames",
        "",
    ),
}
