"""Geometry and dynamics identified together (``calib identify --with-geometry``), beside the two stages.

Files in addition to those of every identification::

    robot.toml, chain_covariance.csv   the robot with the geometry after the torques, and its covariance
    geometry_from_torques.csv          each independent element, with those of the same effect, and tilt of gravity:
                                       change by the torques, σ before and after; identified: the torques reduce its
                                       variance by half or more; surprise: change in units of its σ if poses and torques
                                       agree
    joint_covariance.csv               of elements, tilts and dynamic parameters, with their correlations

The two stages stand beside as the plain reference. They are kept where the joint estimate predicts held-out torques
or the fit's held-out poses worse, and where the torques contradict the geometry before: a log of another arm must not
move it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import erfc

from calib import files
from calib.errors import Finding, UsageError, finding, require
from calib.folders import write_covariance
from calib.identification.friction.friction_ladder import NAMES
from calib.identification.identify import Identification, identify
from calib.identification.methods.least_squares import LeastSquares
from calib.identification.prediction import predict
from calib.identification.registry import method_named
from calib.identification.uncertainty.geometry_uncertainty import GeometryUncertainty
from calib.procedure.dynamic_stage.held_out_poses import HeldOutErrors, held_out_errors
from calib.procedure.dynamic_stage.inputs import IdentificationInputs, Progress
from calib.procedure.dynamic_stage.verdict import model_findings
from calib.robot.calibrated import CalibratedChain
from calib.units import TORQUE

if TYPE_CHECKING:
    from calib.identification.uncertainty.joint_estimate import JointEstimate

# ratio of squared errors on held-out torques up to which the joint estimate is not worse (our choice)
MAX_HELD_OUT = 1.001
# probability below which torques and geometry contradict each other, by the largest of all distances (our choice)
CONTRADICTION = 1e-4
# difference of identified and stated mass, as a share, from which on the stated payload is not used (our choice)
MAX_MASS_ERROR = 0.1
TABLE, COVARIANCE = "geometry_from_torques.csv", "joint_covariance.csv"
HEADER = ("element", "unit", "change", "sigma_before", "sigma_after", "surprise", "identified")


@dataclass(frozen=True, eq=False)
class GeometryFromTorques:
    """Geometry from poses and torques, and whether it is the result's.

    Attributes:
        estimate: the joint estimate.
        delivered: whether the robot of the result has this geometry; otherwise it has that before the torques.
        noticed: findings.
        unseen: ratio of squared errors on held-out recordings to those of the two stages; None without such recordings.
        regrouped: the estimate by independent elements.
        poses: errors of the fit's held-out poses with its geometry and with this one; None without such poses.
    """

    estimate: JointEstimate
    delivered: bool
    noticed: tuple[Finding, ...]
    unseen: float | None
    regrouped: JointEstimate
    poses: HeldOutErrors | None = None

    @property
    def held_out(self) -> float:
        """Ratio of squared errors on held-out recordings, or else on held-out time of the training recordings."""
        return self.estimate.held_out if self.unseen is None else self.unseen


@dataclass(frozen=True)
class ElementChange:
    """Change of an element by the torques [m or rad]; fields as in ``geometry_from_torques.csv``."""

    element: str
    unit: str
    change: float
    sigma_before: float
    sigma_after: float
    surprise: float
    identified: bool


@dataclass(frozen=True)
class GeometryFromTorquesMetrics:
    """The entry ``geometry_from_torques`` of ``metrics.json``.

    Attributes:
        delivered: whether the robot of the result has this geometry.
        held_out: ratio of squared errors on held-out torques to those of the two stages.
        combinations: number of independent combinations of elements that the torques determine.
        widening: factor by which the variance of the torques was raised, median over combinations of elements.
        elements: free elements, and tilts of gravity.
        gains: gain of each torque row, measured over true torque, with its standard deviation.
        poses: errors of the fit's held-out poses with its geometry and with this one; None without such poses.
    """

    delivered: bool
    held_out: float
    combinations: int
    widening: float
    elements: tuple[ElementChange, ...]
    gains: tuple[tuple[float, float], ...] = ()
    poses: HeldOutErrors | None = None


def run_jointly(
    inputs: IdentificationInputs, say: Progress
) -> tuple[IdentificationInputs, Identification, GeometryFromTorques]:
    """Return the inputs with the robot of the result, its identification, and the geometry from torques.

    Args:
        inputs: robot, recordings and options.
        say: called with a text on each step.

    Raises:
        UsageError: for another robot than an arm, methods without rows, or torques of unknown gain.
    """
    from calib.identification.uncertainty.joint_estimate import identify_jointly  # slow to load

    settings = inputs.options.settings
    _require_usable(inputs)
    plain = identify(inputs.robot, inputs.cases, settings, say)
    if plain.friction.chosen in NAMES:
        settings = replace(settings, friction=plain.friction.chosen)
    doubted = _doubted_payloads(inputs, plain)

    identify_all = partial(identify_jointly, plain, inputs.robot, inputs.cases, settings, doubted)
    if inputs.robot.covariance is not None or inputs.robot.corrections is not None:
        by_torques = identify_all(fitted=False, progress=say).estimate
        contradicting = contradictions(by_torques, inputs.robot)
        if contradicting:
            return inputs, plain, GeometryFromTorques(by_torques, False, contradicting, None, by_torques)
    joint, robot, joint_identification = identify_all(progress=say)
    unseen = _unseen_ratio(inputs, plain, joint_identification)
    poses = held_out_errors(inputs.source, inputs.robot.complete, robot.complete)
    result = GeometryFromTorques(joint, True, (), unseen, joint.regrouped(inputs.robot.complete), poses)
    worse = _worse_on_held_out(result)
    if worse is not None:
        return inputs, plain, replace(result, delivered=False, noticed=(worse,))
    if poses is None:
        result = replace(result, noticed=(finding("geometry-without-poses"),))
    gravity = joint_identification.settings.gravity
    options = replace(inputs.options, settings=replace(inputs.options.settings, gravity=gravity))
    return replace(inputs, robot=robot, options=options), joint_identification, result


def _worse_on_held_out(result: GeometryFromTorques) -> Finding | None:
    """Return a finding if the joint estimate is worse on held-out torques or poses than the two stages; else None."""
    if result.held_out > MAX_HELD_OUT:
        return finding("geometry-not-better", ratio=result.held_out)
    poses = result.poses
    if poses is not None and poses.is_worse:
        rms = {"before": poses.before, "after": poses.after}
        return finding("geometry-worse-on-poses", poses=poses.poses, rise=poses.rise, **rms)
    return None


def _require_usable(inputs: IdentificationInputs) -> None:
    """Raise a UsageError for robots, methods and torques from which no geometry is estimated."""
    settings = inputs.options.settings
    require(
        isinstance(inputs.robot, CalibratedChain),
        "with_geometry: for serial arms only; identify this robot without it",
        UsageError,
    )
    require(
        inputs.unit == TORQUE,
        f"with_geometry: needs torques in N m, found {inputs.unit}: state the drives' gains, or record torques",
        UsageError,
    )
    method = method_named(settings.method)
    usable = isinstance(method, LeastSquares) and settings.torque_rows.has_bodies
    usable = usable and settings.torque_rows.projection is None
    require(
        usable,
        f"with_geometry: method '{settings.method}' with rows '{settings.torque_rows.name}' does not support it: use "
        "method wls with rows motor, link or both",
        UsageError,
    )


def _doubted_payloads(inputs: IdentificationInputs, plain: Identification) -> tuple[str, ...]:
    """Return the labels of payloads whose stated mass the torques contradict; they do not serve as references."""
    labels = []
    for item in model_findings(inputs.cases, plain):
        wrong_mass = item.code == "payload-mass" and float(item.values["off"]) > MAX_MASS_ERROR
        if wrong_mass or item.code in ("payload-absent", "payload-exchanged"):
            labels.append(str(item.values["label"]))
    return tuple(labels)


def _unseen_ratio(inputs: IdentificationInputs, plain: Identification, joint: Identification) -> float | None:
    """Return the ratio of squared errors on held-out recordings, joint estimate to two stages; None without any.

    Args:
        inputs: the held-out recordings are among them.
        plain: identification of the two stages.
        joint: identification on the geometry of the joint estimate.
    """
    if not inputs.unseen:
        return None
    squares = np.zeros(2)
    for case in inputs.unseen:
        for k, identification in enumerate((joint, plain)):
            residual = case.target - predict(identification.dynamics, case)
            in_band = case.motion.in_band(residual)
            squares[k] += np.sum((in_band * case.present / plain.fitted.std) ** 2)
    return float(squares[0] / squares[1])


def contradictions(by_torques: JointEstimate, robot: CalibratedChain) -> tuple[Finding, ...]:
    """Return a finding on the element in which torques contradict a robot's fit most; empty if none does.

    The limit is that of the largest of all compared distances by chance (Bonferroni).

    Args:
        by_torques: joint estimate without the prior of the fit.
        robot: the robot with the covariance of its fit.
    """
    distances = np.abs(by_torques.distances(robot))
    worst = int(np.argmax(distances))
    compared = max(int(np.count_nonzero(distances)), 1)
    p_value = compared * float(erfc(distances[worst] / np.sqrt(2.0)))
    if p_value > CONTRADICTION:
        return ()
    # mm or mrad
    shift = f"{1e3 * by_torques.change[worst]:.3g} m{by_torques.units[worst]}"
    return (finding("geometry-contradicted", element=by_torques.elements[worst], moved=shift, sigmas=distances[worst]),)


def with_covariance(carried: GeometryUncertainty, result: GeometryFromTorques) -> GeometryUncertainty:
    """Return the geometry's contribution to the dynamics' covariance, that of the tilts of gravity included.

    Args:
        carried: contribution of the geometry after the torques, without the tilts.
        result: geometry from torques, which is delivered.
    """
    joint = result.estimate
    index = list(joint.index)
    slopes = carried.sensitivity[:, index]
    deviations = np.array(carried.deviations)
    deviations[index] = joint.sigma
    return replace(carried, geometry=slopes @ joint.covariance @ slopes.T, deviations=deviations)


def write(result: GeometryFromTorques, carried: GeometryUncertainty, folder: Path) -> None:
    """Write the table of the geometry from torques and, where it is delivered, the joint covariance.

    Args:
        result: geometry from torques.
        carried: contribution of the geometry to the dynamics' covariance.
        folder: folder to write into.
    """
    rows = []
    for row in changes(result.regrouped):
        identified = "yes" if row.identified else "no"
        rows.append((row.element, row.unit, row.change, row.sigma_before, row.sigma_after, row.surprise, identified))
    files.write_table(folder / TABLE, HEADER, rows)
    if not result.delivered:
        return
    joint = result.estimate
    slopes = carried.sensitivity[:, list(joint.index)]
    between = slopes @ joint.covariance
    covariance = np.block([[joint.covariance, between.T], [between, carried.covariance]])
    write_covariance(folder / COVARIANCE, (*joint.elements, *carried.names), covariance)


def changes(joint: JointEstimate) -> tuple[ElementChange, ...]:
    """Return each free element and tilt before and after the torques."""
    result = []
    for k, (element, unit) in enumerate(zip(joint.elements, joint.units)):
        result.append(
            ElementChange(
                element=element,
                unit=unit,
                change=float(joint.change[k]),
                sigma_before=float(joint.sigma_before[k]),
                sigma_after=float(joint.sigma[k]),
                surprise=float(joint.surprise[k]),
                identified=bool(joint.identified[k]),
            )
        )
    return tuple(result)


def metrics(result: GeometryFromTorques) -> GeometryFromTorquesMetrics:
    """Return the entry of ``metrics.json``."""
    joint = result.estimate
    gains = zip(joint.gains.tolist(), joint.gain_sigma.tolist())
    return GeometryFromTorquesMetrics(
        delivered=result.delivered,
        held_out=result.held_out,
        combinations=joint.identified_combinations,
        widening=joint.widening,
        elements=changes(result.regrouped),
        gains=tuple(gains),
        poses=result.poses,
    )
