"""Standing joints: a standstill counts once, whatever torque holds the joint there; reversals and sensors do not."""

from dataclasses import replace

import numpy as np
import planted_motion as planted
import pytest

from calib.data.recordings.recording import Recording
from calib.data.signals.motion import FilterOptions, make_motion
from calib.errors import UsageError
from calib.identification import standstill
from calib.identification.identify import Identification, chain_states, common_decimator, find_base, identify
from calib.identification.identify_options import parse_options
from calib.identification.prediction import predict, score
from calib.identification.prior import first_fit
from calib.identification.rows import Case, ObservationRows, make_case, observe, with_blocks
from calib.identification.settings import IdentificationSettings, make_model
from calib.identification.standstill import (
    divided,
    left_out_error,
    standing_joints,
    with_breakaway,
    with_standstills,
    with_weights,
)
from calib.identification.uncertainty.learned_torque_errors import learn_torque_errors
from calib.identification.uncertainty.torque_errors import intervals

PLAIN = IdentificationSettings(friction="standard", essential="none")
WIDTH = np.full(planted.N, 0.01)  # of Coulomb's sign [rad/s]
PAUSES = ((2.0, 4.0), (7.0, 10.0), (13.0, 15.0), (18.0, 22.0))  # [s]


def stop_and_go(seed: int, pauses=PAUSES, noise: float = 0.2) -> Case:
    """Return a case of a motion with pauses, in which each motor holds any torque within its static friction."""
    period, speed = 1.0 / planted.RATE, np.ones(int(30.0 * planted.RATE))
    t = period * np.arange(len(speed))
    for first, end in pauses:
        speed[(t >= first) & (t < end)] = 0.0
    smooth = np.hanning(int(0.6 * planted.RATE))
    speed = np.convolve(speed, smooth / smooth.sum(), mode="same")
    phase = period * np.cumsum(speed)
    grid, path, *_ = planted.motion(seed, duration=40.0, harmonics=3)
    q = np.column_stack([np.interp(phase, grid, column) for column in path.T])
    recording = Recording(t, q, np.zeros_like(q), "torque", ("joint1", "joint2", "joint3"), file=f"log{seed}")
    motion = make_motion(recording, FilterOptions(cutoff=10.0, band=8.0))
    torque = planted.torques(motion.q, motion.v, motion.a)
    rng = np.random.default_rng(seed)
    friction = np.array(planted.DRIVES["Fc"])
    stands = standing_joints(replace(make_case("x", motion)), WIDTH)
    for first, end in pauses:
        inside = (motion.t >= first) & (motion.t < end)
        held = rng.uniform(-1.0, 1.0, planted.N) * friction - np.tanh(motion.v[inside] / 0.01) * friction
        torque[inside] += np.where(stands[inside], held, 0.0)
    effort = torque + noise * rng.normal(size=torque.shape)
    return make_case(f"log{seed}", replace(motion, effort=effort))


def rows_of(case: Case, settings: IdentificationSettings = PLAIN, marks: bool = True) -> list[ObservationRows]:
    model, decimator = make_model(planted.arm(), settings), common_decimator([case], settings)
    base = find_base(model, [case], chain_states(planted.arm(), model))
    plain = with_blocks([observe(model, base.kept, case, decimator)], 6)
    return with_standstills(plain, [case], decimator, model, base.kept, WIDTH, marks=marks)


def wrong_friction(found: Identification) -> float:
    """Return the rms relative error of Coulomb's friction."""
    values = dict(zip(found.names, found.fitted.estimate.values))
    away = [values[f"Fc{j + 1}"] / size - 1.0 for j, size in enumerate(planted.DRIVES["Fc"])]
    return float(np.sqrt(np.mean(np.square(away))))


def in_motion(found: Identification, case: Case) -> float:
    """Return the relative error of the torques of moving joints [%]."""
    return score(case, predict(found.dynamics, case)).moving.total


@pytest.mark.slow
def test_friction_returns_despite_standing(monkeypatch):
    """With standing rows as any others it is several times as wrong, and so is motion that the fit has not seen."""
    cases, other = [stop_and_go(seed) for seed in range(3)], stop_and_go(7)
    counted = [identify(planted.arm(), [case], PLAIN) for case in cases]
    monkeypatch.setattr(standstill, "MIN_STANDSTILL", 1e6)
    as_others = [identify(planted.arm(), [case], PLAIN) for case in cases]
    assert np.mean(list(map(wrong_friction, counted))) < 0.5 * np.mean(list(map(wrong_friction, as_others)))
    unseen, before = (np.mean([in_motion(found, other) for found in each]) for each in (counted, as_others))
    assert unseen < before


def test_estimates_hold_where_joints_stand():
    """Estimates are within their covariance where joints stand."""
    size = []
    for seed in range(4):
        found = identify(planted.arm(), [stop_and_go(seed)], replace(PLAIN, prior="none"))

        values = found.base.transform @ planted.truth()
        away = (found.fitted.estimate.values - values) / found.fitted.estimate.sigma
        size.append(np.sqrt(np.mean(away**2)))
    assert 0.4 < np.mean(size) < 2.0


def test_standstill_weighs_as_one_row():
    """A standstill weighs as one row of its friction, however long it lasts."""
    rows = rows_of(stop_and_go(0))
    parts = divided(rows)
    np.testing.assert_allclose(parts.standstills, len(PAUSES))
    values = np.zeros(parts.moving.parameters)
    values[parts.coulomb.argmax(axis=1)] = planted.DRIVES["Fc"]
    std, tau = np.full(3, 0.05), np.full(3, 2.0)
    weights = parts.weights(values, std, tau)
    residual = parts.standing.residual_squares(values) / parts.standstills
    spread = np.maximum(np.array(planted.DRIVES["Fc"]) ** 2 / 3.0, residual)
    assert (weights.worth <= tau * std**2 / spread).all() and (weights.worth > 0.9 * tau * std**2 / spread).all()
    part = replace(rows[0], rest=weights)
    total = np.sum(part.weight**2 * (part.standing > 0.0), axis=0)
    frictions = len(PAUSES) * (1.0 + parts.swing / weights.reach)
    np.testing.assert_allclose(total, frictions * weights.worth, rtol=1e-9)
    assert (frictions < 1.5 * len(PAUSES)).all(), "nothing moves, so that the torque hardly changes"


def test_changed_load_counts_standstill_anew():
    """What other joints do to a standing one is seen beyond the width of its friction."""
    rows = rows_of(stop_and_go(0))
    values, std, tau = np.zeros(rows[0].matrix.shape[2]), np.full(3, 0.05), np.full(3, 2.0)
    values[rows[0].coulomb.argmax(axis=1)] = 1e3 * np.array(planted.DRIVES["Fc"])  # larger than any residual
    parts = divided(rows)
    reach = parts.weights(values, std, tau).reach
    np.testing.assert_allclose(reach, 2.0 * values[rows[0].coulomb.argmax(axis=1)], rtol=1e-3)
    loaded = [replace(part, swing=np.where(part.standing > 0.0, 3.0 * reach, 0.0)) for part in rows]
    again = divided(loaded)
    weights = again.weights(values, std, tau)
    part = replace(loaded[0], rest=weights)
    total = np.sum(part.weight**2 * (part.standing > 0.0), axis=0)
    np.testing.assert_allclose(total, 4.0 * len(PAUSES) * weights.worth, rtol=1e-9)
    np.testing.assert_allclose(again.joined(weights).residual_squares(values)[0], np.sum(
        part.weight[:, 0] ** 2 * (part.target[:, 0] - part.matrix[:, 0] @ values) ** 2
    ), rtol=1e-6)  # fmt: skip


def test_frictionless_standing_has_all_rows():
    """Without friction a standstill weighs as all its rows."""
    parts = divided(rows_of(stop_and_go(0)))
    standing = replace(parts.standing, factors=np.zeros_like(parts.standing.factors))
    weights = replace(parts, standing=standing).weights(np.zeros(parts.moving.parameters), np.ones(3), np.full(3, 5.0))
    frictions = 1.0 + parts.swing / weights.reach
    np.testing.assert_allclose(frictions * weights.worth, parts.length)
    np.testing.assert_allclose(frictions * weights.count, parts.length)


def test_uninterrupted_motion_has_all_rows():
    """Motion without standstill keeps all its rows."""
    part = rows_of(planted.case("a", 0))[0]
    assert not part.standing.any() and (part.weight == part.present).all()


def test_only_coulomb_columns_vanish_at_rest():
    """Coulomb columns are zero at rest, and no others."""
    case = stop_and_go(0)
    rows, plain = rows_of(case)[0], observe(*_observed(case))
    rests = rows.standing > 0.0
    changed = (rows.matrix != plain.matrix).any(axis=0)
    assert (changed <= rows.coulomb).all() and changed.any()
    for row in range(planted.N):
        assert not rows.matrix[rests[:, row]][:, row][:, rows.coulomb[row]].any()


def _observed(case: Case):
    model, decimator = make_model(planted.arm(), PLAIN), common_decimator([case], PLAIN)
    return model, find_base(model, [case], chain_states(planted.arm(), model)).kept, case, decimator


@pytest.mark.parametrize("drives", ["Ia Fv off", ""])
def test_no_coulomb_drives_no_standstills(drives):
    """Direct drives, say: at rest their torque is as determined as in motion."""
    part = rows_of(stop_and_go(0), replace(PLAIN, sets=(drives,)) if drives else PLAIN)[0]
    assert part.standing.any() == (not drives)


def test_joint_that_never_moves_keeps_rows():
    """A joint that never moves keeps its rows."""
    case = stop_and_go(0)
    motion = case.motion
    moves = np.arange(3) != 1
    still = replace(case, motion=replace(motion, q=motion.q * moves, v=motion.v * moves, a=motion.a * moves))
    standing = rows_of(still)[0].standing
    assert not standing[:, 1].any() and standing[:, [0, 2]].any(axis=0).all()


@pytest.mark.parametrize("marks", [True, False])
def test_noise_of_a_joint_that_never_moves_tells_no_friction(marks):
    """The sign of its velocity is that of noise: its column of Coulomb friction is zero, and its rows stay."""
    case = stop_and_go(0)
    motion = case.motion
    v = motion.v.copy()
    v[:, 1] = 1e-3 * np.random.default_rng(0).normal(size=len(v))
    part = rows_of(replace(case, motion=replace(motion, v=v)), marks=marks)[0]
    name = list(part.names).index
    assert not part.matrix[:, 1, name("Fc2")].any() and not part.standing[:, 1].any()
    assert part.matrix[:, 0, name("Fc1")].any()


@pytest.mark.slow
def test_intervals_have_two_widths():
    """Intervals have two widths and hold in both."""
    covered = []
    for seed in range(3):
        train = [stop_and_go(seed)]
        found = identify(planted.arm(), train, PLAIN)
        errors, other = learn_torque_errors(found, train), stop_and_go(seed + 10)
        assert errors is not None
        stated = intervals(errors, found.dynamics, other, predict(found.dynamics, other))
        assert (stated.median_at_rest > 1.5 * stated.median).all()
        covered.append([stated.contains[~stated.standing].mean(), stated.contains[stated.standing].mean()])
    moving, resting = np.mean(covered, axis=0)
    assert 0.92 < moving <= 1.0 and resting > 0.85


def test_cut_slow_names_its_replacement():
    """The option cut_slow is refused, with what replaced it."""
    with pytest.raises(UsageError, match="cut_slow: standing rows are no longer cut"):
        parse_options({"cut_slow": True})


def test_dropped_motion_asks_for_no_rows():
    """Left-out motion does not ask for standing rows where friction holds them."""
    case = stop_and_go(3)
    rows = rows_of(case)
    first = first_fit(rows)
    rows = with_weights(rows, first.rest_weights)
    as_moving = [replace(part, standing=np.zeros_like(part.standing)) for part in rows]
    once = left_out_error(rows, rows, first.std, first.inflation, None, ())
    first_as_moving = first_fit(as_moving)
    others = left_out_error(as_moving, rows, first_as_moving.std, first_as_moving.inflation, None, ())
    assert 0.0 < once < standstill.CLEARLY_LESS**-2 * others, "friction at rest is random here: once is right"
    assert left_out_error(rows, rows, first.std, first.inflation, None, range(planted.N)) == 0.0, (
        "rows that no total holds"
    )


@pytest.mark.parametrize("reach", [0.0, 0.01])
def test_fading_friction_lowers_later_rows(reach):
    """Friction at rest is random here; planted is how far it goes on while the joint moves away."""
    case = stop_and_go(4)
    decimator, torque_rows = common_decimator([case], PLAIN), make_model(planted.arm(), PLAIN).torque_rows
    (part,) = rows_of(case)
    values = first_fit([part]).values
    travel = standstill._travel_since_standstill(part, case, decimator, torque_rows)
    rests = part.standing > 0.0
    rng = np.random.default_rng(0)
    friction = np.where(rests, 20.0, 0.0)
    if reach:
        friction = np.where(rests, friction, 20.0 * np.exp(-travel / reach))
    residual = rng.normal(size=rests.shape) + friction * rng.normal(size=rests.shape)
    part = replace(part, target=part.matrix @ values + residual)
    (weighed,) = with_breakaway([part], [case], decimator, torque_rows, values)
    if reach == 0.0:
        assert (weighed.breakaway == 1.0).all()
        return
    near, far = ~rests & (travel < 0.3 * reach), ~rests & (travel > 5.0 * reach)
    assert near.any() and weighed.breakaway[near].max() < 0.2 and weighed.breakaway[far].min() > 0.99


def test_rows_before_a_standstill_are_normal():
    """Rows before any standstill are as others."""
    case = planted.case("a", 0)
    (part,) = rows_of(case)
    decimator, torque_rows = common_decimator([case], PLAIN), make_model(planted.arm(), PLAIN).torque_rows
    (weighed,) = with_breakaway([part], [case], decimator, torque_rows, first_fit([part]).values)
    assert (weighed.breakaway == 1.0).all()
