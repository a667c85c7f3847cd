"""Parallel robots: the commands for serial arms, applied to closed loops (`calib.rooms.parallel.mechanism`)."""

OFFERS = {"topics": ":TOPICS", "robots": "robots:find", "stages": "verbs:STAGES", "drive_gains": "gains:drive_gains"}
TOPICS = {
    "parallel": (
        "a parallel robot as legs and a platform, and what commands write of one",
        "calib.rooms.parallel.mechanism.parallel_robot calib.rooms.parallel.loop_fit calib.rooms.parallel.verbs "
        "calib.rooms.parallel.export",
    )
}
