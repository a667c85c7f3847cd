"""What limits the speed and the acceleration of a motion, joint by joint, and where each limit is stated.

No file that a robot may play is written without a `MotionBounds` (`calib.procedure.excitation.folder`,
`calib.rooms.parallel.excite`), and none exists of a joint whose speed, or whose acceleration and torque,
nothing limits. What they are stands at the head of each file.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from calib.errors import UsageError
from calib.robot.chain import Joint
from calib.units import motion_units
from trajectories.setpoints import Setpoints

MAX_SPEED = 100.0  # [rad/s or m/s] a number above that is no limit of a robot's joint (our choice)
MAX_ACCELERATION = 3000.0  # [rad/s² or m/s²] direct drives of fast parallel robots reach 1300 (our choice)
MAX_TORQUE = 1e5  # [N m or N] (our choice)
MAX_EXCESS = 0.01  # of a limit, by which a written sample may be beyond it: rounding to whole samples
DEFAULT_RISE = 2.0  # [1/s] default acceleration limit over the speed limit: full speed in half a second (our choice)
DEFAULT_ORIGIN = f"default, {DEFAULT_RISE:g}/s times the speed limit: none is stated"
PLACE = "in the limits file (--limits, or [dynamics] limits in session.toml)"


@dataclass(frozen=True, eq=False)
class MotionBounds:
    """Largest moduli (n,) of a motion's speeds, accelerations and torques; infinite: none.

    Attributes:
        robot: its file or name, for messages; joints: n of them.
        velocity, acceleration: [rad/s or m/s, and per s].
        torque: [N m or N], where a model predicts torques; else infinite.
        origin: where they are stated, by ``velocity``, ``acceleration`` and ``torque``.
        place: where a user can state what is missing, {} for an example.

    Raises:
        UsageError: naming the joints that nothing limits, and what to state.
    """

    robot: str
    joints: tuple[Joint, ...]
    velocity: np.ndarray
    acceleration: np.ndarray
    torque: np.ndarray
    origin: Mapping[str, str]
    place: str = f"{PLACE}, such as {{}}"

    def __post_init__(self) -> None:
        for what, kinds, advice in (
            ("speed", {"velocity": MAX_SPEED}, '[velocity] all = "90 deg/s"'),
            ("acceleration", {"acceleration": MAX_ACCELERATION, "effort": MAX_TORQUE}, "[acceleration] all = 5.0"),
        ):
            sizes = {"effort": self.torque, "velocity": self.velocity, "acceleration": self.acceleration}
            free = np.all([sizes[kind] > most for kind, most in kinds.items()], axis=0)
            if not free.any():
                continue
            names = self._named(joint for joint, one in zip(self.joints, free) if one)
            written = [words for joint, one in zip(self.joints, free) if one for words in joint.unstated]
            written += [f"{kind} {x:g}" for kind in kinds for x in sizes[kind][free] if np.isfinite(x)]
            wrong = [words for words in dict.fromkeys(written) if words.split()[0] in kinds]
            found = f" ({', '.join(wrong)} is no limit)" if wrong else ""
            other = "" if what == "speed" else "; efforts count where masses are known or a model is named (--model)"
            raise UsageError(
                f"{self.robot}: nothing limits the {what} of {names}{found}, and no motion is written without; state "
                f"it {self.place.format(advice)}{other}"
            )

    def _named(self, joints: Iterable[Joint]) -> str:
        names = [joint.name for joint in joints]
        return "all joints" if len(names) == len(self.joints) else ", ".join(names)

    def lines(self) -> list[str]:
        """Return what limits the motion, a line per kind: for the heads of files."""
        result = []
        for number, (kind, most) in enumerate(
            (("velocity", MAX_SPEED), ("acceleration", MAX_ACCELERATION), ("torque", MAX_TORQUE)), 1
        ):
            alike: dict[str, list[Joint]] = {}
            for joint, size in zip(self.joints, getattr(self, kind)):
                words = f"{size:.4g} {motion_units([joint.kind])[number]}" if size <= most else "none"
                alike.setdefault(words, []).append(joint)
            sizes = "; ".join(f"{words} {self._named(joints)}" for words, joints in alike.items())
            result.append(f"{kind} limits: " + ("none" if [*alike] == ["none"] else f"{sizes} ({self.origin[kind]})"))
        return result

    def check(self, track: Setpoints) -> None:
        """Refuse a track that is beyond its limits of speed and acceleration, or beyond what any joint can do.

        Light links and high torque limits allow accelerations that no robot has.

        Raises:
            UsageError: naming the joint.
        """
        for kind, values, most, example in (
            ("velocity", track.v, MAX_SPEED, '[velocity] all = "90 deg/s"'),
            ("acceleration", track.a, MAX_ACCELERATION, "[acceleration] all = 5.0"),
        ):
            peak, limit = np.abs(values).max(axis=0), np.minimum(getattr(self, kind), most)
            j = int(np.argmax(peak / limit))
            if not peak[j] <= (1.0 + MAX_EXCESS) * limit[j]:
                raise UsageError(
                    f"{self.robot}: the {kind} of {self.joints[j].name} reaches {peak[j]:.4g} in this motion, beyond "
                    f"{limit[j]:.4g}, and it is not written; state a limit {self.place.format(example)}"
                )
