"""Files of measuring instruments: joined with the joints of a robot's controller."""

OFFERS = {"commands": "commands:app", "planned_poses": "planned:read_planned", "topics": ":TOPICS"}
TOPICS = {"join": ("joints and points in separate files, for calib join", "calib.rooms.instruments.joining")}
