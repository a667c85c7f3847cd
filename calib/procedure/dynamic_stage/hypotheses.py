"""Findings on another gravity or load that explains recordings better than the stated one (catalogue, chapter 9)."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from calib.column_changes import Explanation
from calib.errors import Finding, finding
from calib.identification.checks.gravity import GravityHypotheses, gravity_of
from calib.identification.checks.mistaken_columns import corrected, without_offsets
from calib.identification.checks.recorded_motion import bodies_under, take_samples
from calib.identification.checks.recording_sizes import MAX_SAMPLES
from calib.identification.checks.unstated_load import unstated_load
from calib.procedure.dynamic_stage.inputs import IdentificationInputs
from calib.robot.chain import Chain
from calib.units import TORQUE

# share that gravity leaves over that which columns leave, from which on columns are the likelier cause (our choice)
MIN_BETTER = 1.5
# largest unexplained share with offsets of the torques, as a share of that without (our choice)
MAX_TARED = 0.6
MAX_COMPARED = 12  # recordings in which an unstated load is looked for (our choice)


def gravity_hypotheses(
    inputs: IdentificationInputs, columns: Mapping[str, Explanation | None] | None = None
) -> GravityHypotheses | None:
    """Return how well other gravity vectors explain the training recordings.

    The recordings are grouped by payload, and the group with the most recordings is used.

    Args:
        inputs: robot, recordings and options.
        columns: recording name -> changes of its columns, which are made first; None: columns as recorded.

    Returns:
        The hypotheses; None without motor torques or with too few samples.
    """
    if not isinstance(inputs.chain, Chain) or not inputs.options.settings.torque_rows.has_bodies:
        return None
    bodies = bodies_under(inputs.chain, inputs.options.settings.gravity)
    loads = [case.carried for case in inputs.cases]
    usual = max(loads, key=loads.count)
    usable = []
    for case in inputs.cases:
        samples = take_samples(case, bodies, MAX_SAMPLES) if case.carried == usual else None
        if samples is not None:
            explanation = columns.get(case.name) if columns else None
            usable.append(corrected(samples, explanation))
    return gravity_of(usable, inputs.chain, inputs.unit == TORQUE) if usable else None


def likelier_gravity(
    inputs: IdentificationInputs, hypotheses: GravityHypotheses | None, columns: Mapping[str, Explanation | None]
) -> GravityHypotheses | None:
    """Return the gravity hypotheses, for corrected columns if these explain the training recordings better.

    Wrong columns may look like another gravity. The hypothesis that leaves the smaller share of the torques decides;
    of similar ones it is gravity, and so it is if the alternative is another robot, whose base may be turned.
    Joints with clipped torques do not tell whether gravity is absent.

    Args:
        inputs: robot, recordings and options.
        hypotheses: gravity, for columns as recorded; None: unknown.
        columns: recording name -> changes of its columns that explain its torques.
    """
    if hypotheses is None:
        return None
    shares = []
    clipped = set()
    for case in inputs.cases:
        explanation = columns.get(case.name)
        if explanation is not None and (explanation.changes[0].joints or hypotheses.direction is None):
            shares.append(explanation.factor)
        for fault in case.motion.faults:
            if fault.kind == "clipped":
                clipped.add(fault.joint)
    if shares and (hypotheses.direction is None or min(shares) * MIN_BETTER < hypotheses.factor):
        hypotheses = gravity_hypotheses(inputs, columns) or hypotheses
    absent = tuple(joint for joint in hypotheses.absent if joint not in clipped)
    return replace(hypotheses, absent=absent)


def gravity_findings(hypotheses: GravityHypotheses | None, joints: Sequence[str]) -> list[Finding]:
    """Return findings if gravity seems to have another direction, or not to act on the torques of some joints.

    Args:
        hypotheses: how well other gravity vectors explain the recordings; None: unknown, which yields no findings.
        joints: names of the joints.
    """
    if hypotheses is None:
        return []
    findings = []
    if hypotheses.direction is not None:
        rival = _vector(-hypotheses.direction, " ") if hypotheses.ambiguous else None
        values = {
            "direction": _vector(hypotheses.direction, " "),
            "option": _vector(hypotheses.direction, ", "),
            "stated": _vector(hypotheses.stated, " "),
            "before": _typical(hypotheses.before),
            "after": _typical(hypotheses.after),
        }
        findings.append(finding("gravity-direction", rival=rival, **values))
    if hypotheses.absent:
        absent = list(hypotheses.absent)
        determined = [joint for joint in absent if np.isfinite(hypotheses.factors[joint])]
        factors = [f"{joints[joint]} {hypotheses.factors[joint]:.2g}" for joint in determined]
        findings.append(finding("gravity-absent", joints=[joints[joint] for joint in absent], factors=factors))
    return findings


def load_findings(inputs: IdentificationInputs, gravity: Sequence[float] | None) -> list[Finding]:
    """Return a finding for each recording whose torques indicate a load that the options do not state.

    All recordings, training and held-out ones, with one stated payload are compared with each other.

    Args:
        inputs: the recordings.
        gravity: gravity (3,) in the base frame [m/s²]; None: gravity of the robot's description.
    """
    rows = inputs.options.settings.torque_rows
    if not isinstance(inputs.chain, Chain) or inputs.unit != TORQUE or not rows.has_bodies:
        return []
    bodies = bodies_under(inputs.chain, gravity)
    cases = [*inputs.cases, *inputs.unseen]
    findings = []
    for carried in dict.fromkeys(case.carried for case in cases):
        samples = {}
        for case in cases:
            sampled = take_samples(case, bodies, MAX_SAMPLES) if case.carried == carried else None
            if sampled is not None and len(samples) < MAX_COMPARED:
                samples[case.name] = sampled
        load = unstated_load(samples)
        if load is not None:
            findings.append(
                finding(
                    "payload-unstated",
                    file=load.name,
                    mass=load.mass,
                    sigma=load.sigma,
                    reach=load.reach,
                    before=load.before,
                    after=load.after,
                )
            )
    return findings


def tare_findings(inputs: IdentificationInputs, gravity: Sequence[float] | None) -> list[Finding]:
    """Return a finding for each recording whose torques were tared: they start or average at zero, unlike gravity's.

    Args:
        inputs: the recordings.
        gravity: gravity (3,) in the base frame [m/s²]; None: gravity of the robot's description.
    """
    if not isinstance(inputs.chain, Chain) or not inputs.options.settings.torque_rows.has_bodies:
        return []
    bodies = bodies_under(inputs.chain, gravity)
    findings = []
    for case in (*inputs.cases, *inputs.unseen):
        for kind, verb in (("mean", "average"), ("start", "start")):
            kinds = {fault.kind for fault in case.motion.faults}
            samples = take_samples(case, bodies, MAX_SAMPLES) if kind in kinds else None
            if samples is None:
                continue
            without, with_offsets = without_offsets(samples)
            if with_offsets < MAX_TARED * without:
                findings.append(finding("torques-tared", file=case.name, kind=verb, before=without, after=with_offsets))
    return findings


def _typical(shares: np.ndarray) -> float:
    """Return the geometric mean over the joints of their unexplained shares (n,) of the torque."""
    return float(np.exp(np.mean(np.log(shares))))


def _vector(vector: np.ndarray, between: str) -> str:
    """Return a vector (3,) [m/s²] as text, with the components separated by the text `between`."""
    return between.join(f"{component:.4g}" for component in np.round(vector, 3) + 0.0)
