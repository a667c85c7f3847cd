"""Scene of a result for the viewer, as plain arrays: robot, poses with their errors, motions, torques.

All points are in the base frame of the drawn robot. `calib.results.scene_files` reads a scene from a folder, and
`calib.apps.viewer.viewer` shows it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from calib.records import Frozen
from calib.robot.chain import Chain, Joint
from calib.robot.kinematics import forward, joint_frames

# Positions of the arm per second of motion (our choice).
FRAMES = 50.0
# Standard deviations of a normal distribution that contain 95 %.
SIGMAS = 1.96


@runtime_checkable
class Drawn(Protocol):
    """A robot to draw that is not a serial arm, as the command ``view`` of its kind returns it.

    Attributes:
        n, joints, joint_names: number, properties and names of the actuated joints.
    """

    @property
    def n(self) -> int: ...
    @property
    def joints(self) -> tuple[Joint, ...]: ...
    @property
    def joint_names(self) -> tuple[str, ...]: ...

    def strips(self, q: np.ndarray) -> list[np.ndarray]:
        """Return polylines (m, k, 3) [m] that represent the robot at joint readings q (m, n).

        The first polyline ends at the point whose errors are shown.
        """
        ...

    def torque_rows(self, kind: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return titles and units of an identification's torque rows.

        Args:
            kind: value of ``kind`` in ``dynamics.json``.
        """
        ...

    def measured(self, folder: Path) -> tuple[np.ndarray, ...]:
        """Return the arrays of `Measured`, in the order of its fields, for the poses in a fit's folder."""
        ...


@dataclass(frozen=True, eq=False)
class Visual(Frozen):
    """A mesh file that moves with a link.

    Attributes:
        link: name of the link.
        file: the mesh.
        placement: (4, 4) pose of the mesh in the link's frame.
        scale: (3,) scale factors along the axes of the mesh.
    """

    link: str
    file: Path
    placement: np.ndarray
    scale: np.ndarray


@dataclass(frozen=True, eq=False)
class Measured:
    """m measured poses: target positions as measured, and as predicted by the nominal and the calibrated arm.

    Attributes:
        q: (m, n) joint values [rad or m].
        seen, nominal, calibrated: (m, 3) measured and predicted positions [m].
        unseen: (m,) whether the row was held out from the fit.
        turned: (m, 3) rotation vector from the calibrated arm's orientation to the measured one, as in
            ``residuals.csv`` [rad]; NaN if no orientation was measured.
        interval: (m,) radius within which the fit expects 95 % of the calibrated arm's errors [m]; NaN for fitted rows;
            None: unknown.
    """

    q: np.ndarray
    seen: np.ndarray
    nominal: np.ndarray
    calibrated: np.ndarray
    unseen: np.ndarray
    turned: np.ndarray
    interval: np.ndarray | None = None

    def arrow_scale(self, chain: Chain | Drawn) -> float:
        """Return a factor (1, 2 or 5 times a power of ten) by which the viewer enlarges error arrows.

        Large arrows are then about a tenth of the arm's extent.

        Args:
            chain: the robot that is drawn.
        """
        span = float(np.ptp(strips(chain, self.q)[0][:, -1], axis=0).max()) or 1.0
        large = float(np.quantile(np.linalg.norm(self.seen - self.nominal, axis=1), 0.9)) or 1e-3
        target = 0.1 * span / large
        scales = np.outer(10.0 ** np.arange(7), [1.0, 2.0, 5.0]).ravel()
        return float(scales[np.argmin(np.abs(np.log(scales / target)))])


@dataclass(frozen=True, eq=False)
class ErrorSizes:
    """Errors of m measured rows without a position in the arm's base frame: magnitudes only.

    Distances, bars, sockets, planes and images measure no position. Validation rows with a base and tool placement of
    their own measure positions in a frame that the fit's folder does not contain.

    Attributes:
        kind: ``position`` if the row's residual is a position (in the instrument's frame, from a socket's mean point or
            from a plane), otherwise ``distance``.
        q: (m, n) joint values [rad or m].
        nominal, calibrated: (m,) magnitudes of both arms' errors [m]; NaN if the fit does not state them.
        unseen: (m,) whether the row was held out from the fit.
        interval: (m,) as that of `Measured`.
    """

    kind: str
    q: np.ndarray
    nominal: np.ndarray
    calibrated: np.ndarray
    unseen: np.ndarray
    interval: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Played:
    """A motion of the drawn robot.

    Attributes:
        name: name in the viewer.
        t: (N,) times [s].
        q: (N, n) joint values [rad or m].
        v: (N, n) joint velocities [rad/s or m/s]; None: unknown.
    """

    name: str
    t: np.ndarray
    q: np.ndarray
    v: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Torques:
    """Measured and predicted torques of a recording.

    Attributes:
        name: name of the recording.
        rows, units: name (joint and kind) and unit of each torque row.
        t: (N,) times [s].
        measured, predicted: (N, rows) torques.
        q: (N, n) joint values [rad or m]; None: unknown.
        sigma: (N, rows) expected standard deviations of measured minus predicted; None: unknown.
        nominal: (N, rows) torques of the model that was identified on the nominal (CAD) geometry; None: unknown.
    """

    name: str
    rows: tuple[str, ...]
    units: tuple[str, ...]
    t: np.ndarray
    measured: np.ndarray
    predicted: np.ndarray
    q: np.ndarray | None
    sigma: np.ndarray | None = None
    nominal: np.ndarray | None = None

    @property
    def band(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Lower and upper bound (N, rows) of the interval that is expected to contain 95 % of the measured torques."""
        if self.sigma is None:
            return None
        return self.predicted - SIGMAS * self.sigma, self.predicted + SIGMAS * self.sigma


@dataclass(frozen=True, eq=False)
class TradeOffs:
    """Front of trade-offs of a designed motion.

    Attributes:
        name: name of the motion.
        objectives: names of the two objectives, each the smaller the better.
        values: (k, 2) of the front's motions.
        best: (k,) whether no other motion is better in both.
        designed: index of the motion that was designed.
    """

    name: str
    objectives: tuple[str, ...]
    values: np.ndarray
    best: np.ndarray
    designed: int

    @property
    def drawn(self) -> np.ndarray:
        """Return the values (k, 2) scaled to 0 to 1, since the objectives have different units."""
        low = self.values.min(axis=0)
        span = np.ptp(self.values, axis=0)
        return (self.values - low) / np.where(span > 0.0, span, 1.0)

    @property
    def labels(self) -> list[str]:
        """Return one text per motion: its number, as of ``--pick``, and its values."""
        labels = []
        for number, row in enumerate(self.values, 1):
            pairs = [f"{name} {value:.4g}" for name, value in zip(self.objectives, row)]
            labels.append(f"{number}: {', '.join(pairs)}")
        return labels


@dataclass(frozen=True, eq=False)
class Scene:
    """Robot, poses, motions and torques to show.

    Attributes:
        title: title of the scene.
        chain: the robot to draw; None: unknown.
        meshes: meshes of the robot's links.
        measured: measured poses with their errors.
        sizes: errors of rows without a measured position in the arm's base frame.
        chosen: names and joint values (m, n) of lists of selected poses, in the order of selection.
        played: motions.
        torques: torques of recordings.
        fronts: fronts of trade-offs of designed motions.
        notes: texts on results that could not be shown.
    """

    title: str
    chain: Chain | Drawn | None = None
    meshes: tuple[Visual, ...] = ()
    measured: tuple[Measured, ...] = ()
    sizes: tuple[ErrorSizes, ...] = ()
    chosen: tuple[tuple[str, np.ndarray], ...] = ()
    played: tuple[Played, ...] = ()
    torques: tuple[Torques, ...] = ()
    fronts: tuple[TradeOffs, ...] = ()
    notes: tuple[str, ...] = ()


def strips(chain: Chain | Drawn, q: np.ndarray) -> list[np.ndarray]:
    """Return the polylines (m, k, 3) [m] that represent a robot at joint values q (m, n) [rad or m].

    Args:
        chain: the robot; a serial arm has one polyline, through base, joints and tip.
        q: joint values of m poses.
    """
    if isinstance(chain, Chain):
        return [skeleton(chain, q)]
    return chain.strips(q)


def skeleton(chain: Chain, q: np.ndarray) -> np.ndarray:
    """Return the positions (m, n + 2, 3) [m] of base, joints and tip of an arm.

    Args:
        chain: the arm.
        q: (m, n) joint values of m poses [rad or m].
    """
    points = np.zeros((len(q), chain.n + 2, 3))
    points[:, 1:-1] = joint_frames(chain, q)[:, :, :3, 3].transpose(1, 0, 2)
    points[:, -1] = forward(chain, q)[:, :3, 3]
    return points


def thinned(t: np.ndarray, rate: float = FRAMES) -> np.ndarray:
    """Return indices of samples about 1 / `rate` apart, including the last sample, to draw fewer of them."""
    step = 1
    if len(t) > 1:
        period = float(np.median(np.diff(t)))
        step = max(1, round(1.0 / (rate * period)))
    last = len(t) - 1
    return np.unique([*range(0, len(t), step), last])
