"""Results of all kinds by one protocol: opened from their folders, in memory, and as the viewer draws them."""

from calib.api.rendering import Unjudged
from calib.results.registry import drawn, open_result
from calib.results.result import Result, StoredResult
from calib.results.scene import Drawn as DrawnRobot
from calib.results.scene import ErrorSizes, Measured, Played, Scene, Torques, skeleton, strips, thinned

__all__ = [
    "DrawnRobot",
    "ErrorSizes",
    "Measured",
    "Played",
    "Result",
    "Scene",
    "StoredResult",
    "Torques",
    "Unjudged",
    "drawn",
    "open_result",
    "skeleton",
    "strips",
    "thinned",
]
