"""Compliance from encoders on both sides of the gears: recovered beside a delay, not claimed where it is not told."""

import numpy as np
import planted_motion as planted
import pytest

from calib.data.recordings.recording import Recording
from calib.data.signals.motion import FilterOptions, make_motion
from calib.identification.checks.joint_compliance import (
    EncoderDifference,
    JointCompliance,
    compared,
    encoder_difference,
)
from calib.identification.prediction import Dynamics
from calib.identification.rows import Case, make_case
from calib.procedure.dynamic_stage.verdict import elastic_findings

COMPLIANCE = np.array([0.0, -3e-5, -8e-5])  # [rad/(N m)]
DELAY = 0.003  # of the link encoders [s]
NOISE = 2e-5  # of an encoder [rad]
MODEL = Dynamics(planted.model(), planted.truth())


def recorded(seed: int, noise: float = NOISE, delay: float = DELAY) -> Case:
    """Return a recording of 20 s with link encoders."""
    t, q, v, a = planted.motion(seed)
    bodies = np.array(planted.truth())
    bodies[len(planted.INERTIAS.ravel()) :] = 0.0
    torque = planted.model().regressor(q, v, a) @ bodies
    rng = np.random.default_rng(seed)
    link = q - delay * v + COMPLIANCE * torque + 0.01 + noise * rng.normal(size=q.shape)
    names = ("joint1", "joint2", "joint3")
    recording = Recording(t, q, planted.torques(q, v, a), "torque", names, q_link=link)
    return make_case(f"log {seed}", make_motion(recording, FilterOptions(cutoff=30.0, band=10.0)))


def estimated(*cases: Case) -> EncoderDifference:
    """Return the estimate from recordings, with the true masses."""
    difference = encoder_difference(MODEL, cases)
    assert difference is not None
    return difference


@pytest.mark.slow
def test_compliance_and_delay_are_recovered_within_their_sigmas():
    errors: list[float] = []
    for seed in range(5):
        difference = estimated(recorded(seed))
        errors += [(joint.compliance - COMPLIANCE[joint.joint]) / joint.sigma for joint in difference.joints]
        assert difference.delay == pytest.approx(DELAY, abs=1e-4)
        assert [joint.joint for joint in difference.joints if joint.identified] == [1, 2]
    assert np.mean(np.abs(errors) < 1.96) > 0.85


def test_a_delay_is_not_taken_for_elasticity():
    difference = estimated(recorded(1))
    for joint in difference.joints:
        assert joint.delayed < 0.3 * joint.difference
        assert joint.residual < 2.0 * NOISE


def test_compliance_of_another_source_predicts_the_difference_within_its_noise():
    case = recorded(2)
    poses = [JointCompliance(j, COMPLIANCE[j], 1e-7, 0.0, 0.0, 0.0) for j in range(3)]
    difference = estimated(case)
    predicted = compared(poses, MODEL, [case])
    assert predicted is not None
    for joint, best in zip(predicted.joints, difference.joints):
        assert joint.residual < 1.05 * best.residual
    stiff = compared([JointCompliance(2, 0.0, 1e-7, 0.0, 0.0, 0.0)], MODEL, [case])
    assert stiff is not None and stiff.joints[0].residual > 5.0 * difference.joints[2].residual


def test_delay_and_compliance_are_findings():
    findings = {finding.code: finding.values for finding in elastic_findings([recorded(1)], MODEL)}
    assert set(findings) == {"encoders-late", "elastic-joints", "joint-compliance"}
    assert findings["encoders-late"]["delay"] == pytest.approx(1e3 * DELAY, abs=0.1)
    assert findings["joint-compliance"]["stiffness"] == pytest.approx(-1.0 / COMPLIANCE[2], rel=0.1)
    on_time = {finding.code for finding in elastic_findings([recorded(1, delay=0.0)], MODEL)}
    assert "encoders-late" not in on_time


def test_without_link_encoders_there_is_no_estimate():
    assert encoder_difference(MODEL, [planted.case("log", 0)]) is None
