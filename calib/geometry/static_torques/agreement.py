"""Measured torques of several files, each judged by the gravity that the others tell: do they agree?

A file agrees if some load, and the gravity of the others within its covariance, explain the torques of most of its
rows. Where it does not, changes that would cure it are tried: another sign, columns exchanged, another unit.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from calib.data.poses.measurements import PoseMeasurements
from calib.errors import Finding, finding, listing
from calib.geometry.static_torques.column_faults import ColumnChange, column_changes
from calib.geometry.static_torques.gravity_fit import (
    GAIN,
    MAX_RESIDUAL,
    ROUNDS,
    Fault,
    GravityFit,
    by_stated_load,
    fault_of_file,
    gravity_factor,
    gravity_fit,
    gravity_regressor,
    load_deviations,
    millimetre_fault,
    most_probable,
    nothing_read,
    rows_with_torques,
    spreads,
)
from calib.robot.chain import Chain
from calib.robot.kinematics import gravity_torques

# share of a file's rows at rest from which on its torques are those of the arm with some load (our choice)
MIN_AT_REST = 0.5


class Agreement(NamedTuple):
    """How far torques of a file agree with a gravity.

    Attributes:
        at_rest: share of the rows with torques in which all of these are explained; 0 where none were measured.
        distance: mean of the squared residuals over the largest ones of an arm at rest, each 1 at most.
    """

    at_rest: float
    distance: float

    @property
    def agrees(self) -> bool:
        """Whether the torques are those of the arm with some load."""
        return self.at_rest >= MIN_AT_REST


def agreeing_torques(
    chain: Chain, blocks: Sequence[PoseMeasurements]
) -> tuple[GravityFit | None, tuple[PoseMeasurements, ...], list[Finding]]:
    """Return the gravity of files whose torques agree, the blocks without torques that do not, and findings on these.

    The odd file is the one without which the others agree best; of two it is the one with fewer rows
    of torques, or the later. Files that show no gravity are judged first, by single files that do.

    Args:
        chain: the arm, with its described masses if they are known.
        blocks: the blocks of measurements.
    """
    result = list(blocks)
    findings: list[Finding] = []
    for block in blocks:
        findings += unread_torques(block)
    several = sum(block.measured_torque is not None for block in blocks) > 1
    if several and len(chain.driven) == chain.n:
        for number, block in enumerate(blocks):
            fault = None
            if block.measured_torque is not None:
                fault = fault_of_file(chain, block)
            if fault is not None:
                result[number], remark = _without_torques(block, fault)
                findings.append(remark)
        findings += _drop_files_without_gravity(chain, result)
        findings += _drop_odd_files(chain, result)
    gravity, faults = gravity_fit(chain, result)
    return gravity, tuple(result), findings + faults


def unread_torques(block: PoseMeasurements) -> list[Finding]:
    """Return a finding on torques that are in a block's file, but not read."""
    if block.torque_fault is None:
        return []
    return [_unused(block, block.torque_fault)]


def without_contradicting_torques(
    block: PoseMeasurements, gravity: GravityFit, fitted: Sequence[PoseMeasurements]
) -> tuple[PoseMeasurements, list[Finding]]:
    """Return a block without its measured torques where no load explains them, and a finding on these.

    Args:
        block: measurements that were not fitted.
        gravity: the gravity of the fitted ones.
        fitted: the fitted blocks, whose files are named.
    """
    if block.measured_torque is None or agreement(block, gravity).agrees:
        return block, []
    block, remark = _without_torques(block, contradiction(block, gravity, fitted))
    return block, [remark]


def agreement(block: PoseMeasurements, gravity: GravityFit) -> Agreement:
    """Return how far the measured torques of a block agree with a gravity, with any load.

    Args:
        block: measurements with torques.
        gravity: the gravity of other files.
    """
    return _LoadedGravity.at(block, gravity).agreement(block)


def contradiction(block: PoseMeasurements, gravity: GravityFit, reference: Sequence[PoseMeasurements]) -> Fault:
    """Return why torques of a block are not those of the arm with any load, and what to do.

    Args:
        block: measurements with torques.
        gravity: the gravity of other files.
        reference: their blocks.
    """
    torque = np.asarray(block.measured_torque)
    fault = nothing_read(torque)
    if fault is not None:
        return fault
    names = listing(sorted({Path(peer.file).name for peer in reference if peer.measured_torque is not None}))
    expected = gravity.sign * gravity_torques(gravity.chain, block.q)
    factor, sigma = gravity_factor(expected, torque)
    fault = millimetre_fault(factor, sigma, names)
    if fault is not None:
        return fault
    loaded = _LoadedGravity.at(block, gravity)
    smallest = np.inf
    cure = "were they read at rest, by the same sensors, in the same unit and joint order as those of the fit?"
    fault = f"with the gravity of {names}, no load explains them", cure
    for change in _changes(torque.shape[1], names):
        changed = loaded.agreement(replace(block, measured_torque=change.of(torque)))
        if changed.agrees and changed.distance < smallest:
            smallest, fault = changed.distance, change.fault
    return fault


def _changes(n: int, names: str) -> Iterator[ColumnChange]:
    """Yield changes of torques: another sign of all, or of one column, or two columns exchanged.

    Args:
        n: number of joints.
        names: names of the files that the torques are compared with.
    """
    turned = f"their sign is the other one than in {names}", "reverse the sign of all of them"
    yield ColumnChange(np.arange(n), -np.ones(n), turned)
    yield from column_changes(np.ones(n, dtype=bool))


@dataclass(frozen=True, eq=False)
class _LoadedGravity:
    """Gravity at a block's rows, which may change within its covariance, and by any load of each group of rows.

    Attributes:
        gravity: the gravity of other files.
        groups: rows of the same load.
        torque: (m, n) torques of this gravity without load [N m].
        matrix: (m, n, 5 n + 4) their changes by one standard deviation of each direction.
    """

    gravity: GravityFit
    groups: list[np.ndarray]
    torque: np.ndarray
    matrix: np.ndarray

    @classmethod
    def at(cls, block: PoseMeasurements, gravity: GravityFit) -> "_LoadedGravity":
        """Return a gravity at the rows of a block."""
        n = gravity.chain.n
        regressor = gravity_regressor(gravity.chain, block.q)
        variances, directions = np.linalg.eigh(gravity.covariance)
        root = directions * np.sqrt(np.maximum(variances, 0.0))
        offsets = np.tile(np.eye(n), (len(block), 1, 1))
        of_gravity = np.concatenate([regressor, offsets], axis=2) @ root
        of_load = regressor[..., -4:] * load_deviations(gravity.chain)
        torque = gravity_torques(gravity.chain, block.q)
        return cls(gravity, by_stated_load(block), torque, np.concatenate([of_gravity, of_load], axis=2))

    def agreement(self, block: PoseMeasurements) -> Agreement:
        """Return how far the torques of a block with these rows agree with the gravity, with any load."""
        balancing = self.gravity.balancing(block)
        at_rest, distance = [], []
        for rows in self.groups:
            ratio = self._residual_ratio(balancing[rows], rows)
            measured = np.isfinite(ratio)
            resting = np.all(~(ratio >= 1.0), axis=1)
            at_rest += resting[measured.any(axis=1)].tolist()
            distance += np.minimum(ratio[measured], 1.0).tolist()
        return Agreement(float(np.mean(at_rest or [0.0])), float(np.mean(np.square(distance or [0.0]))))

    def _residual_ratio(self, balancing: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Return the residuals (r, n) over the largest ones of an arm at rest; NaN where no torque was read.

        Args:
            balancing: (r, n) torques that balance gravity in rows of the same load [N m].
            rows: (r,) numbers of these rows.
        """
        deviation = balancing - self.torque[rows]
        matrix = self.matrix[rows]
        unit = np.ones(matrix.shape[2])
        sigma = np.hypot(self.gravity.sigma, GAIN * np.nan_to_num(np.abs(balancing)))
        residual = deviation
        weights = np.isfinite(deviation)
        for _ in range(ROUNDS):
            changes, _ = most_probable(matrix, deviation, weights / sigma, unit)
            residual = deviation - matrix @ changes
            weights = np.abs(residual) < MAX_RESIDUAL * np.maximum(spreads(residual), sigma)
        return np.abs(residual) / (MAX_RESIDUAL * sigma)


def _drop_files_without_gravity(chain: Chain, blocks: list[PoseMeasurements]) -> list[Finding]:
    """Take the torques from blocks, in place, that neither show a gravity nor agree with that of a file that does.

    Torques of a single pose show none, but agree.

    Args:
        chain: the arm.
        blocks: the blocks of measurements.
    """
    gravities: list[GravityFit] = []
    reference: list[PoseMeasurements] = []
    doubtful = []
    for number, block in enumerate(blocks):
        gravity, faults = gravity_fit(chain, [block])
        if gravity is not None:
            gravities.append(gravity)
            reference.append(block)
        elif faults:
            doubtful.append(number)
    findings: list[Finding] = []
    if not gravities:
        return findings
    for number in doubtful:
        block = blocks[number]
        if not any(agreement(block, gravity).agrees for gravity in gravities):
            fault = contradiction(block, gravities[0], reference[:1])
            blocks[number], remark = _without_torques(block, fault)
            findings.append(remark)
    return findings


def _drop_odd_files(chain: Chain, blocks: list[PoseMeasurements]) -> list[Finding]:
    """Take the torques from blocks, in place, until those of all agree with the others'; return the findings.

    Args:
        chain: the arm.
        blocks: the blocks of measurements.
    """
    findings = []
    numbers = [number for number, block in enumerate(blocks) if block.measured_torque is not None]
    while _disagreement(chain, [blocks[number] for number in numbers]) > 0.0:
        # a file that disagrees does so with a gravity of the others: at least this remainder has one
        ranks = []
        gravities: dict[int, GravityFit] = {}
        for number in numbers:
            reference = [blocks[peer] for peer in numbers if peer != number]
            gravity, _ = gravity_fit(chain, reference)
            if gravity is not None:
                gravities[number] = gravity
                rows = rows_with_torques(np.asarray(blocks[number].measured_torque))
                ranks.append((_disagreement(chain, reference), rows, -number))
        odd = -min(ranks)[-1]
        numbers.remove(odd)
        reference = [blocks[number] for number in numbers]
        fault = contradiction(blocks[odd], gravities[odd], reference)
        blocks[odd], remark = _without_torques(blocks[odd], fault)
        findings.append(remark)
    return findings


def _disagreement(chain: Chain, blocks: Sequence[PoseMeasurements]) -> float:
    """Return the sum of distances of files from the gravity of the others; 0 where all agree.

    Args:
        chain: the arm.
        blocks: blocks with torques.
    """
    total = 0.0
    for number, block in enumerate(blocks):
        reference = [*blocks[:number], *blocks[number + 1 :]]
        gravity, _ = gravity_fit(chain, reference)
        if gravity is None:
            continue
        result = agreement(block, gravity)
        if not result.agrees:
            total += result.distance
    return total


def _without_torques(block: PoseMeasurements, fault: Fault) -> tuple[PoseMeasurements, Finding]:
    """Return a block without its measured torques, and the finding on their fault."""
    return replace(block, measured_torque=None), _unused(block, fault)


def _unused(block: PoseMeasurements, fault: Fault) -> Finding:
    """Return the finding on torques in a block's file that are not used."""
    reason, cure = fault
    return finding("torques-unused", files=[block.file], reason=reason, cure=cure)
