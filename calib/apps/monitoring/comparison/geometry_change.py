"""Change of the geometry between two calibrations: a test in identifiable combinations, and the motion of the tool.

J is the derivative of the target's pose at the poses of both fits by the parameters. Motions of base and tool are
projected out of J, since their placements are not properties of the robot. With the singular value decomposition J = U
S Vᵀ, the rows of Vᵀ are the identifiable combinations of parameters, which are tested
(`calib.apps.monitoring.comparison.change_test`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.apps.monitoring.comparison.change_test import ChangeTest, ParameterChange, Tested, span, tested
from calib.apps.monitoring.comparison.geometry_calibration import Calibration
from calib.apps.monitoring.settings import DiffSettings
from calib.errors import UsageError, require
from calib.toolkit.chains import evaluate, random_joints
from calib.toolkit.installations import Installation, NoOptics, layout_counts, project_out, see, target_jacobian
from calib.transforms import invert, rotation_vector

LEVER = 0.1  # that weighs a target's turn against its way [m/rad]: a tool's usual length (our choice)
MAX_POSES = 300  # of each fit, and at random
SHOWN = 1e-7  # of the largest singular value: below it, no pose shows a combination
PARALLEL = 1e-2  # share of a parameter's motion that base and tool do not take up; below it, no pose shows it alone


@dataclass(frozen=True, eq=False)
class ToolMotion:
    """Motion of the target between two calibrations, at several poses.

    Where changes of base and tool placement are not to count, both placements are fitted so that the motion is
    smallest.

    Attributes:
        where: description of the poses.
        q: (m, n) joint values [rad or m].
        points: (m, 3) target positions in the base frame [m].
        position, orientation: (m,) distance [m] and angle [rad] of the motion.
        expected: rms of the distance that is expected from both covariances if nothing changed [m].
    """

    where: str
    q: np.ndarray
    points: np.ndarray
    position: np.ndarray
    orientation: np.ndarray
    expected: float

    @property
    def rms(self) -> float:
        """Rms of the motion of the target's position [m]."""
        return float(np.sqrt(np.mean(self.position**2)))


@dataclass(frozen=True)
class GeometryChange(ChangeTest):
    """Change of the geometry between two calibrations, with the result of the change test.

    Attributes:
        by_joint: for each joint (name, rms motion of the target if only that joint's parameters had changed [m]).
        motions: motion of the target at the poses of both fits, then at random poses.
        frames: motion (6,) [m, rad] of ``base`` and ``tool`` between the calibrations; empty for a nominal robot.
    """

    by_joint: tuple[tuple[str, float], ...]
    motions: tuple[ToolMotion, ...]
    frames: dict[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class _Seen:
    """Target poses at joint values q, and their change; motions of base and tool that do not count are projected out.

    Attributes:
        q: (m, n) joint values [rad or m].
        points: (m, 3) target positions in the base frame [m].
        rows: (p, 6 m) derivatives of the poses by the parameters, rotations multiplied by the length `LEVER`.
        change: (6 m,) change of the poses, rotations multiplied by `LEVER`.
    """

    q: np.ndarray
    points: np.ndarray
    rows: np.ndarray
    change: np.ndarray

    def motion(self, where: str, covariance: np.ndarray) -> ToolMotion:
        """Return the motion of the target at these poses.

        Args:
            where: description of the poses, such as "at random poses".
            covariance: (p, p) covariance of the parameters' change, from which the expected motion is computed.
        """
        motions = self.change.reshape(2, 3, -1)
        distances = np.linalg.norm(motions[0], axis=0)
        turns = np.linalg.norm(motions[1], axis=0) / LEVER
        expected = self.size(_root(covariance).T)
        return ToolMotion(where, self.q, self.points, distances, turns, expected)

    def size(self, steps: np.ndarray) -> float:
        """Return the rms motion [m] of the target if the parameters change by independent steps.

        Args:
            steps: (k, p) steps of the p parameters.
        """
        displacements = (steps @ self.rows).reshape(len(steps), 6, len(self.q))[:, :3]
        return float(np.sqrt(np.sum(displacements**2) / len(self.q)))


@dataclass(frozen=True, eq=False)
class _Pair:
    """Two arms with one station and one target each, and the difference of their parameters.

    The parameters are those of the arm, those of base and tool where they count, and those of the joint corrections.

    Attributes:
        cells: earlier and later installation; a base or tool that does not count is equal in both.
        taken_up: indices of base and tool in the cells' parameter vector where they do not count; they are projected
            out.
        free: indices of the p compared parameters.
        change: (p,) later minus earlier values.
        covariances: (p, p) covariance of the earlier, and of the later estimate.
    """

    cells: tuple[Installation, Installation]
    taken_up: np.ndarray
    free: np.ndarray
    change: np.ndarray
    covariances: tuple[np.ndarray, np.ndarray]

    def see(self, q: np.ndarray) -> _Seen:
        """Return the target's poses and their change between both arms at joint values q (m, n) [rad or m]."""
        earlier, later = self.cells
        base_before = base_after = None
        if earlier.deflection.terms:
            base_before = evaluate(earlier.deflection, q)
        if later.deflection.terms:
            base_after = evaluate(later.deflection, q)
        before = see(earlier, q, 0, 0, base_before)
        after = see(later, q, 0, 0, base_after)
        rotation_before = before.poses()[:, :3, :3]
        rotation_after = after.poses()[:, :3, :3]
        turns = rotation_vector(rotation_after @ np.swapaxes(rotation_before, 1, 2))
        change = np.concatenate([after.point - before.point, LEVER * turns.T]).reshape(1, -1)

        count = len(self.taken_up)
        parameters = np.append(self.taken_up, self.free)
        columns = target_jacobian(earlier, before, parameters, 0, np.zeros(len(q), int), base_before)
        columns[:, 3:] *= LEVER
        columns = np.concatenate([columns.reshape(len(columns), -1), change])
        if count:
            columns = project_out(columns, np.arange(count))
        return _Seen(q, before.point.T, columns[count:-1], columns[-1])


def compare(before: Calibration, after: Calibration, settings: DiffSettings) -> GeometryChange:
    """Return the change of the geometry between two calibrations.

    Args:
        before, after: the earlier and the later calibration.
        settings: whether changes of base and tool placement count, and the seed of random poses.

    Raises:
        UsageError: base or tool are to count, but one calibration does not have them.
    """
    pair = _pair(before, after, settings)
    chain = before.chain
    fitted_joints = []
    for calibration in (before, after):
        joints = calibration.fitted_joints
        if joints is not None:
            stride = max(1, -(-len(joints) // MAX_POSES))
            fitted_joints.append(joints[::stride])
    require(fitted_joints, f"{before.name}, {after.name}: no residuals.csv with fitted rows; fit again", UsageError)
    sight = pair.see(np.concatenate(fitted_joints))

    test, combinations = _tested(pair, sight)
    covariance = np.add(*pair.covariances)
    sizes = np.linalg.norm(combinations, axis=0)
    changes: list[ParameterChange] = []
    steps = np.zeros((chain.n, len(pair.change)))
    for k, element in enumerate(chain.elements):
        # An element behind the last joint counts as the last joint's.
        steps[min(element.owner, chain.n - 1), k] = pair.change[k]
        if_alone = test.alone(k, sizes[k] > PARALLEL * sizes.max())
        sigma = float(np.sqrt(covariance[k, k]))
        values = chain.values[k], after.chain.values[k]
        changes.append(ParameterChange(element.name, element.unit, *values, sigma, *if_alone))
    changes.sort(key=lambda change: -change.explained)

    at_fits = sight.motion("poses of the fits", covariance)
    random = pair.see(random_joints(chain, MAX_POSES, settings.seed))
    at_random = random.motion("random poses within limits", covariance)
    by_joint = tuple((name, sight.size(step[None])) for name, step in zip(chain.joint_names, steps))
    return GeometryChange(
        chi2=test.chi2,
        freedom=len(test.difference),
        parameters=tuple(changes),
        extra=test.extra,
        by_joint=by_joint,
        motions=(at_fits, at_random),
        frames=frame_changes(before, after),
    )


def corrected_motion(before: Calibration, after: Calibration, settings: DiffSettings) -> float:
    """Return the rms motion [m] of the target at the poses of the later fit, joint corrections of both included.

    Args:
        before, after: the earlier and the later calibration.
        settings: whether changes of base and tool placement count.
    """
    pair = _pair(before, after, settings)
    earlier, later = pair.cells
    cells = (
        replace(earlier, chain=before.cell.chain, deflection=before.cell.deflection),
        replace(later, chain=after.cell.chain, deflection=after.cell.deflection),
    )
    no_parameter = np.zeros(0, dtype=int)
    q = after.fitted_joints
    if q is None:
        q = before.fitted_joints
    assert q is not None
    sight = replace(pair, cells=cells, free=no_parameter).see(q)
    return sight.motion("", np.zeros((0, 0))).rms


def frame_changes(before: Calibration, after: Calibration) -> dict[str, np.ndarray]:
    """Return the motions (6,) [m, rad] of ``base`` and ``tool`` between two fits; empty for a nominal robot.

    Args:
        before, after: the earlier and the later calibration.
    """
    if before.nominal or after.nominal:
        return {}
    station_before, station_after = _compared(before.cell.station_names, after.cell.station_names)
    tool_before, tool_after = _compared(before.cell.tool_names, after.cell.tool_names)
    return {
        "base": _step(before.cell.stations[station_before], after.cell.stations[station_after]),
        "tool": _step(before.cell.tools[tool_before], after.cell.tools[tool_after]),
    }


def _step(T_first: np.ndarray, T_second: np.ndarray) -> np.ndarray:
    """Return the motion (6,) [m, rad] from the first placement to the second, in the frame of the first.

    Args:
        T_first, T_second: (4, 4) the two placements.
    """
    step = invert(T_first) @ T_second
    return np.concatenate([step[:3, 3], rotation_vector(step[:3, :3])])


def _compared(names_before: Sequence[str], names_after: Sequence[str]) -> tuple[int, int]:
    """Return the indices (from 0) of the two stations, or tools, to compare: those with a common name, else 0 and 0.

    Args:
        names_before, names_after: names of the stations or tools in the earlier and in the later calibration.
    """
    for name in names_before:
        if name in names_after:
            return names_before.index(name), names_after.index(name)
    return 0, 0


def _pair(before: Calibration, after: Calibration, settings: DiffSettings) -> _Pair:
    counted_frames = []
    if settings.same_base:
        counted_frames.append("base")
    if settings.same_tool:
        counted_frames.append("tool")
    if counted_frames:
        frames = " and ".join(counted_frames)
        message = f"same {frames}: a nominal robot has no {frames} placement; compare two fits"
        require(not (before.nominal or after.nominal), message, UsageError)
        message = "one fit has joint corrections that the other has not; fit both with the same --model"
        alike = before.cell.deflection.terms == after.cell.deflection.terms
        require(alike, f"same {frames}: {message}", UsageError)

    common_tool = after.cell.tools[0]
    if after.nominal:
        common_tool = before.cell.tools[0]
    stations = _compared(before.cell.station_names, after.cell.station_names)
    tools = _compared(before.cell.tool_names, after.cell.tool_names)
    cells: list[Installation] = []
    covariances = []
    for calibration, station, tool in zip((before, after), stations, tools):
        if counted_frames:
            cell, covariance = calibration.with_corrections
        else:
            cell, covariance = calibration.rigid
        ends = np.cumsum(layout_counts(cell))[:-1]
        sections = np.split(np.arange(len(covariance)), ends)
        base_section = sections[1][6 * station : 6 * station + 6]
        tool_section = sections[2][6 * tool : 6 * tool + 6]
        index = np.concatenate([sections[0], base_section, tool_section, sections[4]])
        covariances.append(covariance[np.ix_(index, index)])
        T_station = np.eye(4)
        if settings.same_base:
            T_station = cell.stations[station]
        T_tool = common_tool
        if settings.same_tool:
            T_tool = cell.tools[tool]
        cells.append(replace(cell, stations=T_station[None], tools=T_tool[None], optics=NoOptics()))

    earlier, later = cells
    base_step = _step(earlier.stations[0], later.stations[0])
    tool_step = _step(earlier.tools[0], later.tools[0])
    terms_step = np.asarray(later.deflection.coefficients) - np.asarray(earlier.deflection.coefficients)
    arm_step = after.chain.values - before.chain.values
    change = np.concatenate([arm_step, base_step, tool_step, terms_step])
    arm = len(before.chain.elements)
    if counted_frames:
        change[:arm] = later.chain.values - earlier.chain.values

    left_out = np.repeat([not settings.same_base, not settings.same_tool], 6)
    taken_up = arm + np.flatnonzero(left_out)
    free = np.setdiff1d(np.arange(len(change)), taken_up)
    block = np.ix_(free, free)
    return _Pair((earlier, later), taken_up, free, change[free], (covariances[0][block], covariances[1][block]))


def _tested(pair: _Pair, sight: _Seen) -> tuple[Tested, np.ndarray]:
    """Return the test of the combinations that are identifiable at the poses, and their derivatives (k, p).

    Args:
        pair: the two arms.
        sight: target poses of both arms.
    """
    _, size, directions = np.linalg.svd(sight.rows.T, full_matrices=False)
    directions = directions[size > SHOWN * size[0]]
    covariances = []
    spans = []
    for covariance in pair.covariances:
        covariances.append(directions @ covariance @ directions.T)
        spans.append(span(directions[:, np.diag(covariance) > 0.0]))
    return tested(directions @ pair.change, covariances, spans, directions)


def _root(covariance: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(covariance)
    return vectors * np.sqrt(np.clip(values, 0.0, None))
