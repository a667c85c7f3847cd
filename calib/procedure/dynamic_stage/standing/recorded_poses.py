"""Torques at standing poses: which files hold them, how they are read, which of them are held out."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calib.data.csv_table import read_header, read_table
from calib.data.recordings.recording import Recording
from calib.data.recordings.recording_files import read_at_rest
from calib.data.schema import refuse
from calib.errors import MeasurementError, listing
from calib.identification.identify_options import IdentifyOptions, read_options
from calib.procedure.robot_kinds import joints_of
from calib.robot.chain import Chain
from calib.robot.library import load_calibrated

# suffixes of tables
TABLES = (".csv", ".txt", ".tsv", ".dat")


# [bytes] a larger log is not searched for standing poses
MAX_BYTES = 50_000_000


# [rad or m], [s] a joint stands where it moves by less for longer; share of the rows that stand in a standing log
STILL, STANDING, SHARE = 1e-3, 0.5, 0.95


# of a table without stamps: more rows than this, with steps of less than this share of their spread, are a motion
MAX_POSES, SMOOTH = 200, 0.05


# [rad/s or m/s] a standing joint has no larger velocity
MAX_SPEED = 0.01


# [rad or m] poses that differ by less are one, fitted or held out together
SAME = 0.02


# share of the poses that is held out where no file is
HELD_OUT = 0.25


@dataclass(frozen=True, eq=False)
class StandingPoses:
    """Torques at standing poses, from one file.

    Attributes:
        name: the file.
        q: (N, n) joint values [rad or m].
        torque: (N, n) torques [N m or N].
        approach: (N, n) direction of the motion before each joint stood, +1, -1 or 0 (unknown); None if not recorded.
        carried: labels of the payloads.
    """

    name: str
    q: np.ndarray
    torque: np.ndarray
    approach: np.ndarray | None
    carried: tuple[str, ...]

    def where(self, rows: np.ndarray) -> "StandingPoses":
        """Return some of the poses, given by their indices or a mask."""
        approach = None if self.approach is None else self.approach[rows]
        return replace(self, q=self.q[rows], torque=self.torque[rows], approach=approach)


def stand(
    robot: str | Path, recordings: Sequence[str], options: Path | None, base: str | None, tip: str | None
) -> bool:
    """Return whether all files are tables of standing poses: without stamps, or logs in which nothing moves for long.

    Args:
        robot: the robot.
        recordings: the files.
        options: the options file.
        base, tip: first and last link of the arm.
    """
    settings = read_options(options)
    chain = None
    for name in recordings:
        path = Path(name)
        if path.suffix.lower() not in TABLES or not path.is_file() or path.stat().st_size > MAX_BYTES:
            return False
        recording_options = settings.file_settings(name).recording
        if recording_options.rate or "t" in recording_options.names or not read_header(path)[0]:
            return False
        chain = chain or load_calibrated(robot, base, tip).chain
        try:
            recording, stamped = read_at_rest(path, joints_of(chain), recording_options)
        except MeasurementError:
            # said by the reader of recordings
            return False
        if not stamped and _moves(recording):
            return False
        if stamped and not len(_standing_rows(recording)):
            return False
    return True


def standing_files(
    robot: str | Path, recordings: Sequence[str], options: Path | None, base: str | None, tip: str | None
) -> list[str]:
    """Return which of several files are tables of standing poses; the arguments are those of `stand`."""
    if len(recordings) < 2:
        return []
    return [name for name in recordings if stand(robot, [name], options, base, tip)]


def _moves(recording: Recording) -> bool:
    """Return whether rows without stamps follow each other as those of a motion do, or have velocities."""
    if recording.v is not None and np.abs(recording.v).max() > MAX_SPEED:
        return True
    spread = np.linalg.norm(recording.q - recording.q.mean(axis=0), axis=1).mean()
    steps = np.linalg.norm(np.diff(recording.q, axis=0), axis=1)
    return len(recording.q) > MAX_POSES and steps.mean() < SMOOTH * spread


def _standing_rows(recording: Recording) -> list[np.ndarray]:
    """Return the rows of each standstill of a log; empty if the log moves."""
    starts = [0]
    for row in range(1, len(recording.q)):
        if np.abs(recording.q[row] - recording.q[starts[-1]]).max() > STILL:
            starts.append(row)
    standing = []
    for first, last in zip(starts, [*starts[1:], len(recording.q)]):
        if recording.t[last - 1] - recording.t[first] >= STANDING:
            standing.append(np.arange(first, last))
    rows = sum(map(len, standing))
    if rows < SHARE * len(recording.q):
        return []
    return standing


def read_poses(path: str, chain: Chain, options: IdentifyOptions) -> StandingPoses:
    """Return the standing poses in a table, or the mean of each standstill of a log.

    Args:
        path: the file.
        chain: the arm.
        options: options with the file's columns and payloads.

    Raises:
        MeasurementError: an invalid file, or currents.
    """
    settings = options.file_settings(path)
    recording, stamped = read_at_rest(Path(path), joints_of(chain), settings.recording)
    if recording.kind == "current":
        raise MeasurementError(
            "has currents: gravity at rest is identified from torques; write columns tau1 … with gain x current [N m]",
            path,
        )
    columns = [f"q{joint}" for joint in range(1, chain.n + 1)]
    columns += [f"tau{joint}" for joint in range(1, chain.n + 1)]
    values = np.hstack([recording.q, recording.effort])
    message = "found {:g} where a number is needed; leave such rows out, or measure them again"
    refuse(recording, ~np.isfinite(values), columns, lambda row, k: message.format(values[row, k]))
    groups: Sequence[np.ndarray] = list(np.arange(len(recording.q))[:, None])
    if stamped:
        groups = _standing_rows(recording)
    q, torque = [], []
    for rows in groups:
        q.append(recording.q[rows].mean(axis=0))
        torque.append(recording.effort[rows].mean(axis=0))
    approach = None
    sides = _approaches(path, chain.n)
    if sides is not None:
        approach = np.array([sides[rows[0]] for rows in groups])
    return StandingPoses(path, np.array(q), np.array(torque), approach, tuple(settings.payload))


def _approaches(path: str, n: int) -> np.ndarray | None:
    """Return the columns ``approach1`` … (N, n) of a table; None without them.

    Raises:
        MeasurementError: some joints have none, or values other than +1, -1 and 0.
    """
    table = read_table(path)
    names = [f"approach{joint}" for joint in range(1, n + 1)]
    absent = [name for name in names if name not in table]
    if len(absent) == n:
        return None
    if absent:
        raise MeasurementError(
            f"has columns of approach for some joints, but no {listing(absent, 3)}: write 0 where it is unknown", path
        )
    sides = np.column_stack([table.numbers(name, None) for name in names])
    message = "found {:g}: an approach is +1 (the joint moved upwards before it stood), -1 (downwards) or 0 (unknown)"
    refuse(table, ~np.isin(sides, (-1.0, 0.0, 1.0)), names, lambda row, k: message.format(sides[row, k]))
    return sides


def divided(blocks: Sequence[StandingPoses], seed: int) -> tuple[list[StandingPoses], list[StandingPoses]]:
    """Return the poses to fit and those held out; rows of one pose stay together.

    Args:
        blocks: the poses of each file.
        seed: seed of the random choice.

    Raises:
        MeasurementError: a file with one distinct pose.
    """
    random = np.random.default_rng(seed)
    training, unseen = [], []
    for block in blocks:
        _, pose = np.unique(np.round(block.q / SAME), axis=0, return_inverse=True)
        distinct = int(pose.max()) + 1
        if distinct == 1:
            raise MeasurementError(
                f"has one distinct pose (rows: {len(block.q)}): measure others too, spread over the joints' ranges",
                block.name,
            )
        chosen = random.permutation(distinct)[: max(1, round(HELD_OUT * distinct))]
        out = np.isin(pose.ravel(), chosen)
        training.append(block.where(~out))
        unseen.append(block.where(out))
    return training, unseen
