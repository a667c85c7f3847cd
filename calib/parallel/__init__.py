"""Parallel robots: the commands for serial arms, applied to closed loops (`calib.parallel.mechanism`)."""

from pathlib import Path

OFFERS = {
    "topics": ":TOPICS",
    "robots": "robots:find",
    "library": ":LIBRARY",
    "stages": "verbs:STAGES",
    "drive_gains": "gains:drive_gains",
}
LIBRARY = Path(__file__).parent / "mechanism" / "library"
TOPICS = {
    "parallel": (
        "a parallel robot as legs and a platform, and what commands write of one",
        "calib.parallel.mechanism.parallel_robot calib.parallel.loop_fit calib.parallel.verbs calib.parallel.export",
    )
}
