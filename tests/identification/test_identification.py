"""Claims on a planted robot: parameters come back within their covariance; the ladder takes what is there, no more."""

import numpy as np
import planted_motion as planted
import pytest

from calib.dynamics import drives as friction
from calib.dynamics.drives import term
from calib.errors import CalibError, MeasurementError, UsageError
from calib.identification.friction.friction_ladder import FrictionCandidates, select_friction
from calib.identification.gains import identify_gains
from calib.identification.identify import chain_states, common_decimator, find_base, identify
from calib.identification.prediction import Dynamics, predict, score
from calib.identification.prior import first_fit
from calib.identification.rows import observe, pool, triangulate, with_blocks
from calib.identification.settings import IdentificationSettings, Payload, make_model

PLAIN = IdentificationSettings(friction="standard")


def errors(found) -> np.ndarray:
    """Return (value - truth) in the metric of the covariance, squared per degree of freedom."""
    true = found.base.transform @ planted.truth()
    off = found.fitted.estimate.values - true
    return off @ np.linalg.solve(found.fitted.estimate.covariance, off) / len(off)


@pytest.mark.parametrize(
    "method", [pytest.param("ols", marks=pytest.mark.slow), "wls", pytest.param("irls", marks=pytest.mark.slow)]
)
def test_base_parameters_within_covariance(method):
    """Base parameters come back within their covariance."""
    settings = IdentificationSettings(friction="standard", method=method, essential="none")
    size = [errors(identify(planted.arm(), [planted.case("a", seed)], settings)) for seed in range(5)]
    assert 0.5 < np.mean(size) < 2.0


def test_prediction_is_as_good_as_the_noise():
    """Prediction of other motion is as good as the noise."""
    found = identify(planted.arm(), [planted.case("a", 0)], PLAIN)
    other = planted.case("b", 1)
    scored = score(other, predict(found.dynamics, other))
    np.testing.assert_allclose(scored.raw.rms, 0.2, rtol=0.1)
    assert scored.filtered.total < 0.4 * scored.raw.total


def test_nothing_is_added_to_a_plain_robot():
    found = identify(planted.arm(), [planted.case("a", 0)])
    assert found.friction.terms == () and found.friction.chosen == "standard"
    assert len(found.friction.steps) > 5 and all(rung.note for rung in found.friction.steps[1:])


@pytest.mark.parametrize(
    ("name", "terms", "size"),
    [
        ("load", (friction.term("Ft2", "load", 1, 0.01),), 0.1),
        pytest.param("presliding", (friction.term("Fp2.1", "presliding", 1, 0.02, 0.01),), 2.0, marks=pytest.mark.slow),
        pytest.param("asymmetric", (friction.term("Fva2", "speed", 1),), 0.5, marks=pytest.mark.slow),
    ],
)
def test_ladder_takes_what_is_planted_alone(name, terms, size):
    """The ladder takes what is planted, and only where it is planted."""
    values = {one.name: size for one in terms}
    found = identify(planted.arm(), [planted.case("a", 0, terms=terms, values=values)])
    rungs = {rung.model: rung for rung in found.friction.steps if rung.kept}
    assert f"+ {name}" in rungs and rungs[f"+ {name}"].kept_at_joints == (2,)
    other = planted.case("b", 1, terms=terms, values=values)
    plain = identify(planted.arm(), [planted.case("a", 0, terms=terms, values=values)], PLAIN)
    one, two = (score(other, predict(model.dynamics, other)).filtered.total for model in (plain, found))
    assert two < 0.8 * one


def test_named_rung_is_taken_at_all_joints():
    """A named rung is taken at all joints, whatever it brings."""
    found = identify(planted.arm(), [planted.case("a", 0)], IdentificationSettings(friction="asymmetric"))
    assert [one.name for one in found.friction.terms] == ["Fva1", "Fva2", "Fva3"]
    with pytest.raises(UsageError, match="friction 'stribek' is not one of"):
        select_friction(FrictionCandidates([], [], [], None, *[np.zeros(0)] * 4), "stribek")  # type: ignore[arg-type]


def test_gains_come_from_known_payload():
    """Gains come from a payload of known mass."""
    gains, arm = np.array([8.0, 12.0, 5.0]), planted.arm()
    settings = IdentificationSettings(payloads={"load": Payload(2.0)})
    cases = [planted.case("u", 0, gains=gains, noise=0.1), planted.case("l", 0, ("load",), gains=gains, noise=0.1)]
    model = make_model(arm, settings)
    base = find_base(model, cases, chain_states(arm, model, settings.seed))
    rows = with_blocks([observe(model, base.kept, one, common_decimator(cases, settings)) for one in cases], 6)
    data = pool(triangulate(rows), 3)
    found = identify_gains(data, {"Mload": 2.0}, first_fit(rows)[1])
    assert (np.abs(found.gains - gains) < 4 * found.sigma).all()
    assert (found.sigma[1:] < 0.03 * gains[1:]).all()
    values = dict(zip(found.names, found.values))
    assert values["MZload"] == pytest.approx(0.2, abs=0.05)
    relative = identify_gains(data, {}, reference=1).gains
    np.testing.assert_allclose(relative / relative[1], found.gains / found.gains[1], rtol=0.05)
    with pytest.raises(CalibError, match="payload of known mass"):
        identify_gains(data, {})


@pytest.mark.slow
def test_payload_of_unseen_motion_counts():
    """A payload that only unseen motion carries counts with its stated mass and centre."""
    loaded, errors = planted.case("b", 1, ("load",)), {}
    for payload in (Payload(2.0, (0.05, 0.025, 0.1)), Payload(2.0)):
        settings = IdentificationSettings(friction="standard", payloads={"load": payload})
        dynamics = identify(planted.arm(), [planted.case("a", 0)], settings).dynamics
        errors[payload.com] = score(loaded, predict(dynamics, loaded)).raw.total
    assert errors[0.05, 0.025, 0.1] < 0.1 * errors[None]


def one_sine(name: str = "s"):
    """Return the case of a robot whose joints share one sine."""
    from calib.data.recordings.recording import Recording
    from calib.data.signals.motion import FilterOptions, make_motion
    from calib.identification.rows import make_case

    t = np.arange(0, 30, 1 / planted.RATE)
    w, amplitude, phase = 2 * np.pi * 0.2, np.array([0.8, 0.6, 0.7]), np.array([0.0, 0.3, 1.6])
    q = amplitude * np.sin(w * t[:, None] + phase)
    v, a = amplitude * w * np.cos(w * t[:, None] + phase), -amplitude * w**2 * np.sin(w * t[:, None] + phase)
    tau = planted.torques(q, v, a) + 0.2 * np.random.default_rng(0).normal(size=q.shape)
    recording = Recording(t, q, tau, "torque", ("joint1", "joint2", "joint3"), file=name)
    return make_case(name, make_motion(recording, FilterOptions(cutoff=20.0, band=5.0)))


@pytest.mark.slow
def test_one_sine_is_drawn_to_cad():
    """The estimate from one sine is drawn to the CAD, and says so."""
    found = identify(planted.arm(), [one_sine()])
    assert found.prior is not None and found.prior.source == "cad" and found.friction.terms == ()
    values = dict(zip(found.names, found.fitted.estimate.values))
    assert all(values[name] >= 0.0 for name in values if name[:2] in ("Ia", "Fv", "Fc"))
    other = planted.case("b", 1)
    with_cad = score(other, predict(found.dynamics, other)).raw.total
    without = identify(
        planted.arm(), [one_sine()], IdentificationSettings(friction="standard", prior="none", essential="none")
    )
    assert with_cad < 0.5 * score(other, predict(without.dynamics, other)).raw.total


def test_a_record_too_short_is_refused():
    with pytest.raises(MeasurementError, match="rows remain for"):
        identify(planted.arm(), [planted.case("a", 0, duration=1.3, band=10.0)])


def test_a_term_from_the_options_is_found():
    spring = term("Ks2", "position", 1)
    values = {"Ks2": 15.0}
    data = planted.case("a", 0, terms=(spring,), values=values)
    found = identify(planted.arm(), [data], IdentificationSettings(friction="standard", terms=(spring,)))
    k = found.names.index("Ks2")
    estimate = found.fitted.estimate
    assert estimate.values[k] == pytest.approx(15.0, abs=4 * estimate.sigma[k])


def test_long_recording_loses_rows_not_band():
    """A long recording keeps its band and loses rows."""
    cases = [planted.case("train", 0)]
    all_of_them = common_decimator(cases, IdentificationSettings())
    few = common_decimator(cases, IdentificationSettings(samples=100))
    assert few.band == all_of_them.band and few.factor % all_of_them.factor == 0
    model = planted.model()
    base = find_base(model, cases, chain_states(planted.arm(), model))
    full, part = (observe(model, base.kept, cases[0], one) for one in (all_of_them, few))
    assert len(part.target) <= 101 < len(full.target)
    step = few.factor // all_of_them.factor
    np.testing.assert_allclose(part.matrix, full.matrix[::step], atol=1e-12)
    np.testing.assert_allclose(part.target, full.target[::step], atol=1e-12)


def test_prediction_is_regressor_product():
    """A prediction is the regressor times the parameters."""
    case, model = planted.case("train", 0), planted.model()
    values = planted.truth()
    motion = case.motion
    np.testing.assert_allclose(
        predict(Dynamics(model, values), case), model.regressor(motion.q, motion.v, motion.a) @ values, atol=1e-9
    )
