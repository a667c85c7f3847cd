"""Join measured points with the joint values from a robot's controller: `calib join`."""

OFFERS = {"commands": "commands:app", "planned_poses": "planned:read_planned", "formats": ":FORMATS"}
FORMATS = {
    "join": ("joints and points in separate files, or two streams, for calib join", "calib.apps.joining.joining", "")
}
