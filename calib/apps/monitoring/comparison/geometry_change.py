"""What moved between two calibrations of a robot: a test in identifiable combinations, and the tool's motion.

With J the derivative of the target's pose over the poses of both fits, from which every motion of base and tool is
projected out (they are not the robot's), the rows of V from J = U S Vᵀ are the combinations that poses can show. They
are tested (`calib.apps.monitoring.comparison.change_test`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calib.apps.monitoring.comparison.calibrations import Calibration
from calib.apps.monitoring.comparison.change_test import ChangeTest, ParameterChange, Tested, span, tested
from calib.apps.monitoring.settings import DiffSettings
from calib.errors import UsageError, require
from calib.geometry.installation import Installation, NoOptics, see
from calib.geometry.model_choice.cross_validation import project_out
from calib.geometry.observation import layout_counts, target_jacobian
from calib.robot.calibrated import evaluate
from calib.robot.chain import random_joints
from calib.transforms import invert, rotation_vector

LEVER = 0.1  # that weighs a target's turn against its way [m/rad]: a tool's usual length (our choice)
MAX_POSES = 300  # of each fit, and at random
SHOWN = 1e-7  # of the largest singular value: below it, no pose shows a combination
PARALLEL = 1e-2  # share of a parameter's motion that base and tool do not take up; below it, no pose shows it alone


@dataclass(frozen=True, eq=False)
class ToolMotion:
    """Motion of the target between two calibrations at poses, base and tool placement fitted where they do not count.

    Attributes:
        where: what poses these are.
        q: (m, n) [rad or m].
        points: (m, 3) target positions in the base frame [m].
        position, orientation: (m,) sizes of the motion [m], [rad].
        expected: rms of the position's motion that both covariances let expect [m].
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
    """What moved between two calibrations; the test is in `ChangeTest`.

    Attributes:
        by_joint: (joint, rms motion of the target if only what describes that joint had changed [m]).
        motions: at the poses of both fits, then at random ones.
        frames: motion (6,) [m, rad] of ``base`` and ``tool`` between the two; empty for a nominal robot.
    """

    by_joint: tuple[tuple[str, float], ...]
    motions: tuple[ToolMotion, ...]
    frames: dict[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class _Seen:
    """Target poses at joint values q: derivatives (p, 6 m) and change (6 m,), what base and tool take up projected out.

    Turns are in units of `LEVER`.
    """

    q: np.ndarray
    points: np.ndarray
    rows: np.ndarray
    change: np.ndarray

    def motion(self, where: str, covariance: np.ndarray) -> ToolMotion:
        """Return the targets' motion, and what the covariance (p, p) of the parameters' change lets expect of it."""
        distance, turn = (np.linalg.norm(component, axis=0) for component in self.change.reshape(2, 3, -1))
        return ToolMotion(where, self.q, self.points, distance, turn / LEVER, self.size(_root(covariance).T))

    def size(self, steps: np.ndarray) -> float:
        """Return the rms motion [m] of the targets by independent steps (k, p) of the parameters."""
        displacements = (steps @ self.rows).reshape(len(steps), 6, len(self.q))[:, :3]
        return float(np.sqrt(np.sum(displacements**2) / len(self.q)))


@dataclass(frozen=True, eq=False)
class _Pair:
    """Two arms with one station and one target each, and what is known of their parameters' difference.

    The parameters are those of the arm, then, as far as they count, of base and tool, then of the joint corrections.

    Attributes:
        cells: earlier and later one; a base or tool that does not count is the same in both.
        taken_up: positions in the cells' parameter vector of the base and tool that do not count.
        free: those of the p parameters.
        change: (p,) later minus earlier.
        covariances: (p, p) of either.
    """

    cells: tuple[Installation, Installation]
    taken_up: np.ndarray
    free: np.ndarray
    change: np.ndarray
    covariances: tuple[np.ndarray, np.ndarray]

    def see(self, q: np.ndarray) -> _Seen:
        """Return the targets at joint values q (m, n) [rad or m]."""
        cell = self.cells[0]
        bases = [evaluate(cell_.deflection, q) if cell_.deflection.terms else None for cell_ in self.cells]
        sight_before, sight_after = (see(cell_, q, 0, 0, base) for cell_, base in zip(self.cells, bases))
        turned = rotation_vector(sight_after.poses()[:, :3, :3] @ np.swapaxes(sight_before.poses()[:, :3, :3], 1, 2))
        change = np.concatenate([sight_after.point - sight_before.point, LEVER * turned.T]).reshape(1, -1)
        columns = target_jacobian(
            cell, sight_before, np.append(self.taken_up, self.free), 0, np.zeros(len(q), int), bases[0]
        )
        columns[:, 3:] *= LEVER
        columns = np.concatenate([columns.reshape(len(columns), -1), change])
        columns = project_out(columns, np.arange(len(self.taken_up))) if len(self.taken_up) else columns
        return _Seen(q, sight_before.point.T, columns[len(self.taken_up) : -1], columns[-1])


def compare(before: Calibration, after: Calibration, settings: DiffSettings) -> GeometryChange:
    """Return what moved between two calibrations.

    Raises:
        UsageError: where base or tool shall count, and are not known of both.
    """
    pair, chain = _pair(before, after, settings), before.chain
    fitted_joints = [item.learnt for item in (before, after) if item.learnt is not None]
    require(fitted_joints, f"{before.name}, {after.name}: no residuals.csv with fitted rows; fit again", UsageError)
    sight = pair.see(np.concatenate([item[:: max(1, -(-len(item) // MAX_POSES))] for item in fitted_joints]))
    test, combinations = _tested(pair, sight)
    total, sizes = np.add(*pair.covariances), np.linalg.norm(combinations, axis=0)
    changes, steps = list[ParameterChange](), np.zeros((chain.n, len(pair.change)))
    for k, (element, value_before, value_after) in enumerate(zip(chain.elements, chain.values, after.chain.values)):
        steps[min(element.owner, chain.n - 1), k] = pair.change[k]
        change_alone, sigma = test.alone(k, sizes[k] > PARALLEL * sizes.max()), float(np.sqrt(total[k, k]))
        changes.append(ParameterChange(element.name, element.unit, value_before, value_after, sigma, *change_alone))
    changes.sort(key=lambda item: -item.explained)
    motions = [sight.motion("poses of the fits", total)]
    motions.append(pair.see(random_joints(chain, MAX_POSES, settings.seed)).motion("random poses within limits", total))
    by_joint = tuple((name, sight.size(step[None])) for name, step in zip(chain.joint_names, steps))
    return GeometryChange(
        test.chi2,
        len(test.difference),
        tuple(changes),
        test.extra,
        by_joint,
        tuple(motions),
        frame_changes(before, after),
    )


def corrected_motion(before: Calibration, after: Calibration, settings: DiffSettings) -> float:
    """Return the rms motion [m] of the target at the poses of the later fit, with the joint corrections of both."""
    pair, rigid = _pair(before, after, settings), (before.cell, after.cell)
    cells_with_corrections = tuple(
        replace(cell, chain=corrected.chain, deflection=corrected.deflection)
        for cell, corrected in zip(pair.cells, rigid)
    )
    none = np.zeros(0, dtype=int)
    q = before.learnt if after.learnt is None else after.learnt
    assert q is not None
    return replace(pair, cells=cells_with_corrections, free=none).see(q).motion("", np.zeros((0, 0))).rms


def frame_changes(before: Calibration, after: Calibration) -> dict[str, np.ndarray]:
    """Return the motions (6,) [m, rad] of ``base`` and ``tool`` between two fits; empty for a nominal robot."""
    if before.nominal or after.nominal:
        return {}
    frames_before, frames_after = (
        (calibration.cell.stations[s], calibration.cell.tools[t]) for calibration, s, t in _places(before, after)
    )
    return {name: _step(a, b) for name, a, b in zip(("base", "tool"), frames_before, frames_after)}


def _step(T_first: np.ndarray, T_second: np.ndarray) -> np.ndarray:
    """Return the step (6,) that leads from one placement to the other, along and about the first one's own axes."""
    step = invert(T_first) @ T_second
    return np.concatenate([step[:3, 3], rotation_vector(step[:3, :3])])


def _places(before: Calibration, after: Calibration) -> list[tuple[Calibration, int, int]]:
    """Return the calibrations with the numbers of the station and the tool that are compared: of one name, or first."""
    indices = []
    for kind in ("station_names", "tool_names"):
        names_before, names_after = (getattr(calibration.cell, kind) for calibration in (before, after))
        shared = [name for name in names_before if name in names_after]
        indices.append((names_before.index(shared[0]), names_after.index(shared[0])) if shared else (0, 0))
    return [(calibration, station, tool) for calibration, station, tool in zip((before, after), *indices)]


def _pair(before: Calibration, after: Calibration, settings: DiffSettings) -> _Pair:
    counts = {"base": settings.same_base, "tool": settings.same_tool}
    counted_names = " and ".join(name for name, calibration_ in counts.items() if calibration_)
    if counted_names:
        message = f"a nominal robot has no {counted_names} placement; compare two fits"
        require(not (before.nominal or after.nominal), f"same {counted_names}: {message}", UsageError)
        message = "one fit has joint corrections that the other has not; fit both with the same --model"
        require(
            before.cell.deflection.terms == after.cell.deflection.terms, f"same {counted_names}: {message}", UsageError
        )
    cells, covariances, arm = [], [], len(before.chain.elements)
    tool = (before if after.nominal else after).cell.tools[0]
    for calibration_, station, target in _places(before, after):
        cell, covariance = calibration_.whole if counted_names else calibration_.rigid
        sections = np.split(np.arange(len(covariance)), np.cumsum(layout_counts(cell))[:-1])
        frames = sections[1][6 * station : 6 * station + 6], sections[2][6 * target : 6 * target + 6]
        index = np.concatenate([sections[0], *frames, sections[4]])
        covariances.append(covariance[np.ix_(index, index)])
        placements = (
            cell.stations[station] if counts["base"] else np.eye(4),
            cell.tools[target] if counts["tool"] else tool,
        )
        cells.append(replace(cell, stations=placements[0][None], tools=placements[1][None], optics=NoOptics()))
    steps = [_step(first[0], second[0]) for first, second in zip(*((cell.stations, cell.tools) for cell in cells))]
    terms = [np.asarray(cell.deflection.coefficients) for cell in cells]
    change = np.concatenate([after.chain.values - before.chain.values, *steps, terms[1] - terms[0]])
    if counted_names:
        change[:arm] = cells[1].chain.values - cells[0].chain.values
    left_out = np.repeat([not calibration_ for calibration_ in counts.values()], 6)
    taken_up = arm + np.flatnonzero(left_out)
    free = np.setdiff1d(np.arange(len(change)), taken_up)
    first, second = (calibration_[np.ix_(free, free)] for calibration_ in covariances)
    return _Pair((cells[0], cells[1]), taken_up, free, change[free], (first, second))


def _tested(pair: _Pair, sight: _Seen) -> tuple[Tested, np.ndarray]:
    """Return the test of the combinations that the poses show, and what each parameter does to those tested (k, p)."""
    _, size, directions = np.linalg.svd(sight.rows.T, full_matrices=False)
    directions = directions[size > SHOWN * size[0]]
    spans = [span(directions[:, np.diag(covariance) > 0.0]) for covariance in pair.covariances]
    return tested(
        directions @ pair.change,
        [directions @ covariance @ directions.T for covariance in pair.covariances],
        spans,
        directions,
    )


def _root(covariance: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(covariance)
    return vectors * np.sqrt(np.clip(values, 0.0, None))
