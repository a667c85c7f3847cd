"""Files of measuring instruments: as they come, and joined with the joints of a robot's controller."""

OFFERS = {
    "commands": "commands:app",
    "exports": "exports:translated",
    "planned_poses": "planned:read_planned",
    "topics": ":TOPICS",
    "pose_forms": "robodk:FORMS",
}
TOPICS = {
    "join": ("joints and points in separate files, or two streams, for calib join", "calib.rooms.instruments.joining"),
    "robodk": ("CSV of RoboDK, and of three reflectors without a header", "calib.rooms.instruments.robodk"),
    "instruments": ("text exports of trackers, CMMs and motion capture", "calib.rooms.instruments.exports"),
}
