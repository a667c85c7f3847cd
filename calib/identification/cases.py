"""One recording as identification sees it: its motion, the torques to explain, and what the robot carried."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import frozen
from calib.data.signals.motion import Motion, moving
from calib.dynamics.torque_rows import MOTOR, TorqueRows
from calib.errors import UsageError, refuse_data


@dataclass(frozen=True, eq=False)
class Case:
    """A motion and its torques.

    Attributes:
        name: the recording's, unique among all.
        motion: q, v, a at the full rate.
        target: (N, rows) what the model's rows have to explain, unfiltered [N m or N; A where no gain is known].
        carried: labels of the payloads on board.
        present: (N, rows) which rows may be used: no lost samples, and no slow ones where they are cut.
        noise: (rows,) standard deviation of the targets' samples, as estimated from repeats of the motion; None: not
            known.
        torque_rows: which torques the targets are.
    """

    name: str
    motion: Motion
    target: np.ndarray
    carried: tuple[str, ...]
    present: np.ndarray
    noise: np.ndarray | None = None
    torque_rows: TorqueRows = MOTOR

    @property
    def duration(self) -> float:
        """Length of what the filters left [s]."""
        return len(self.motion) / self.motion.rate


def make_case(
    name: str,
    motion: Motion,
    rows: TorqueRows = MOTOR,
    *,
    gains: np.ndarray | None = None,
    carried: Sequence[str] = (),
    slow: float | Sequence[float] | None = None,
) -> Case:
    """Return the case of a motion.

    Args:
        rows: which torques the model explains; all but the motors' need joint torque sensors (`Motion.tau_link`).
        gains: (n,) torque per unit of the effort; None: 1.
        carried: labels of payloads.
        slow: rows of joints slower than this are not used: a share of the peak speed or (n,) speeds; None:
            all are.
    """
    effort = np.array(motion.effort) if gains is None else motion.effort * gains
    if rows.sensed and motion.tau_link is None:
        refuse_data(
            motion.file,
            f"rows '{rows.name}' need torques of sensors behind the gear (columns tau_l1 …, tau_sensor1 …) beside "
            "motors'",
        )
    target = rows.target(effort, motion.tau_link, motion.q, motion.v)
    known = np.repeat(motion.weight[:, None] > 0.5, motion.n, axis=1)
    if slow is not None:
        known &= moving(motion, slow)
    noise = None
    if motion.effort_variance is not None and rows.motors_alone:
        noise = frozen(np.sqrt(motion.effort_variance) * (1.0 if gains is None else np.abs(gains)))
    return Case(name, motion, frozen(target), tuple(carried), frozen(rows.of_joints(known), bool), noise, rows)


def case_names(paths: Sequence[str]) -> tuple[str, ...]:
    """Return a unique name per recording: the file's, with the cut (or the folder) where that is needed.

    Raises:
        UsageError: where the same recording and cut is given twice.
    """
    twice = sorted({path for path in paths if list(paths).count(path) > 1})
    if twice:
        raise UsageError(f"{twice[0]} is given twice")
    plain = [_file(path) for path in paths]
    tail = [path.replace("\\", "/").rsplit("/", 1)[-1] for path in paths]
    chosen = [p if plain.count(p) == 1 else t for p, t in zip(plain, tail)]
    return tuple(c if chosen.count(c) == 1 else path for c, path in zip(chosen, paths))


def _file(path: str) -> str:
    from calib.data.recordings.recording import parse_cut

    return parse_cut(path)[0].replace("\\", "/").rstrip("/").rsplit("/", 1)[-1]
