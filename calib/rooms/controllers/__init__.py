"""Robot controllers: programs of poses for them, targets inside their programs, their logs; what each can be told."""

OFFERS = {"commands": "commands:app", "topics": ":TOPICS"}
TOPICS = {
    "programs": (
        "programs for robot controllers, of calib program",
        "calib.rooms.controllers.program calib.rooms.controllers.targets calib.rooms.controllers.table",
    )
}
