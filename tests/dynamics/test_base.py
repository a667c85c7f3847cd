"""Base parameters: the counts of the literature, the regrouping formulas of the LWR4+, prediction unchanged."""

from functools import cache

import numpy as np
import pytest
from arms import motley, physical, states
from differences import check

from calib.dynamics import base, drives, rigid_body
from calib.dynamics import drives as friction
from calib.dynamics.bodies import bodies_of, standard_parameters, with_payload
from calib.dynamics.idim import IdentificationModel, from_chain
from calib.dynamics.shapes import RecordedRange
from calib.dynamics.torque_rows import BOTH, DRIVE, LINK, MODELS, MOTOR
from calib.errors import CalibError
from calib.robot.library import load
from calib.simulation import lwr4plus

SENSED = "Ia Fvl Fcl offl Fvm Fcm offm"


@cache
def arm(rows, tilted=False):
    """The study's model: seven joints with torque sensors, payload as body 8, its drive parameters counted too."""
    chain = load("lwr4plus")
    bodies = with_payload(bodies_of(chain), chain.tail)
    bodies = bodies.with_gravity(np.array([1.0, 2.0, -9.5])) if tilted else bodies
    return IdentificationModel(bodies, drives.standard([SENSED] * 7) + drives.without_effect("8"), rows)


@cache
def found(rows):
    return base.find(arm(rows))


def test_counts_of_model_2():
    """136 standard, 18 without effect, 16 regrouped, 102 base (Kolyubin, Shiriaev, Jubien 2019, section 6.2)."""
    result = found(BOTH)
    assert (len(result.standard), len(result.without_effect), len(result.regrouped), result.b) == (136, 18, 16, 102)
    assert result.split.gap > 1e9
    silent = "XX1 XY1 XZ1 YY1 YZ1 MX1 MY1 MZ1 M1 M2 MZ2 Ia8 Fvl8 Fcl8 offl8 Fvm8 Fcm8 offm8"
    assert set(result.without_effect) == set(silent.split())
    late = [f"{name}{j}" for j in range(3, 8) for name in ("YY", "MZ", "M")]
    assert set(result.regrouped) == {"YY2", *late}


@pytest.mark.parametrize(("rows", "count"), [(LINK, 74), (BOTH, 102), (DRIVE, 28), (MOTOR, 79)])
def test_parameter_counts_of_models(rows, count):
    """Counts of models 1, 2, 3 and of motor torques alone."""
    assert found(rows).b == count
    assert MODELS == {1: LINK, 2: BOTH, 3: DRIVE}


@pytest.mark.parametrize("case", [None, ()])
def test_one_load_leaves_payload_in_links(case):
    """One load case leaves the payload in the links."""
    assert base.find(arm(BOTH), loads=(case,)).b == 92


def test_tilted_gravity_adds_two():
    result = base.find(arm(BOTH, tilted=True))
    assert result.b == 104
    assert {"MX1", "MY1"} <= {name.rstrip("R") for name in result.names}


@pytest.mark.parametrize(
    ("robot", "sets", "count"),
    [("lwr4plus", "", 43), ("ur5", "", 36), ("ur5", "Ia", 40), ("tx40", "Ia Fv Fc", 52), ("rv2sq", "Ia Fv Fc", 52)],
)
def test_counts_of_other_arms(robot, sets, count):
    chain = load(robot)
    assert base.find(IdentificationModel(bodies_of(chain), drives.standard([sets] * chain.n))).b == count


@pytest.mark.parametrize(("sets", "count"), [("Ia Fv Fc", 54), ("Ia Fv Fc off", 60)])
def test_counts_of_the_coupled_wrist(sets, count):
    terms = drives.standard([sets] * 6) + drives.coupled(4, 5)[1:]
    assert base.find(IdentificationModel(bodies_of(load("tx40")), terms)).b == count


R3, R5 = 0.40, 0.39
OUTER3, OUTER5 = ("M3", "M4", "M5", "M6", "M7"), ("M5", "M6", "M7")
FORMULAS = {
    "ZZ1": {"YY2": 1},
    "XX2": {"YY2": -1, "YY3": 1, "MZ3": 2 * R3} | dict.fromkeys(OUTER3, R3**2),
    "ZZ2": {"YY3": 1, "MZ3": 2 * R3} | dict.fromkeys(OUTER3, R3**2),
    "MY2": {"MZ3": 1} | dict.fromkeys(OUTER3, R3),
    "XX3": {"YY3": -1, "YY4": 1},
    "ZZ3": {"YY4": 1},
    "MY3": {"MZ4": 1},
    "XX4": {"YY4": -1, "YY5": 1, "MZ5": 2 * R5} | dict.fromkeys(OUTER5, R5**2),
    "ZZ4": {"YY5": 1, "MZ5": 2 * R5} | dict.fromkeys(OUTER5, R5**2),
    "MY4": {"MZ5": -1} | dict.fromkeys(OUTER5, -R5),
    "XX5": {"YY5": -1, "YY6": 1},
    "ZZ5": {"YY6": 1},
    "MY5": {"MZ6": -1},
    "XX6": {"YY6": -1, "YY7": 1},
    "ZZ6": {"YY7": 1},
    "MY6": {"MZ7": 1},
    "XX7": {"YY7": -1},
}


def test_regrouping_of_the_lwr():
    """The formulas that symbolic elimination gives (Khalil & Kleinfinger 1987), every coefficient of all 102 rows."""
    result = found(BOTH)
    wanted = np.zeros((result.b, 136))
    for row, k in enumerate(result.kept):
        wanted[row, k] = 1.0
        for name, coefficient in FORMULAS.get(result.standard[k], {}).items():
            wanted[row, result.standard.index(name)] = coefficient
    assert np.allclose(result.transform, wanted, rtol=0, atol=1e-12)
    lines = base.expressions(result)
    assert "ZZ1R = ZZ1 + YY2" in lines and "MY2R = MY2 + MZ3 + 0.4 M3 + 0.4 M4 + 0.4 M5 + 0.4 M6 + 0.4 M7" in lines
    assert {name[:-1] for name in result.names if name.endswith("R")} == set(FORMULAS)


@pytest.mark.parametrize("rows", [MOTOR, BOTH])
def test_base_and_standard_predict_alike(rows):
    """Base parameters predict what the standard ones do."""
    full, result = arm(rows), found(rows)
    chi = np.random.default_rng(0).normal(size=full.p)
    q, v, a = states(7)
    wanted = full.regressor(q, v, a) @ chi
    reduced = base.BaseModel(full, result)
    beta = result.transform @ chi
    assert np.allclose(reduced.regressor(q, v, a) @ beta, wanted, rtol=0, atol=1e-11)
    assert np.allclose(full.regressor(q, v, a) @ result.to_standard(beta), wanted, rtol=0, atol=1e-11)
    assert reduced.names == result.names and len(reduced.units) == result.b


def test_regrouping_keeps_inertia_matrix():
    """Dropped parameters at zero leave M(q) as it is: a base estimate can be simulated."""
    chain = load("tx40")
    full = IdentificationModel(bodies_of(chain))
    result, chi = base.find(full), standard_parameters(chain)
    q = states(6)[0]
    wanted = rigid_body.mass_matrix(full.bodies, chi, q)
    values = result.to_standard(result.transform @ chi)
    assert np.allclose(rigid_body.mass_matrix(full.bodies, values, q), wanted, rtol=0, atol=1e-12)


def test_gradient_through_the_base_columns():
    reduced = base.BaseModel(arm(BOTH), found(BOTH))
    rng = np.random.default_rng(1)
    x, weights = rng.normal(size=21), rng.normal(size=(1, 14, 102))
    smooth = np.array(["Fc" not in name for name in reduced.names])  # tanh(100 v) is too steep for differences
    weights = weights * smooth
    slopes = reduced.regressor_gradient(*x.reshape(3, 1, 7), weights)
    check(lambda x: np.sum(weights * reduced.regressor(*x.reshape(3, 1, 7))), np.concatenate([g[0] for g in slopes]), x)


@pytest.mark.parametrize("rows", [BOTH, MOTOR])
def test_torque_gradient_by_base_columns(rows):
    """Gradient of torques through the base columns."""
    reduced = base.BaseModel(arm(rows), found(rows))
    rng = np.random.default_rng(2)
    state, values = rng.normal(size=(3, 5, 7)), rng.normal(size=reduced.base.b)
    push = rng.normal(size=(5, reduced.model.rows))
    of_torques = reduced.torque_gradient(*state, values, push)
    assert np.allclose(of_torques, reduced.regressor_gradient(*state, push[:, :, None] * values), rtol=0, atol=1e-10)


def test_regrouping_on_calibrated_geometry():
    """The nominal columns stay, K moves (LWR4+ of the 2019 study, Table 2, rows 2 to 7), and it holds exactly."""
    nominal = IdentificationModel(bodies_of(load("lwr4plus")))
    calibrated = IdentificationModel(bodies_of(lwr4plus.arm(lwr4plus.table_2()[1])))
    first = base.find(nominal)
    second = base.regroup(first, calibrated)
    assert np.array_equal(first.kept, second.kept) and first.names != second.names
    assert first.remainder.max() < 1e-9 and second.remainder.max() < 1e-9
    assert 1e-3 < np.abs(second.transform - first.transform).max() < 0.1
    q, v, a = states(7, 200)
    chi = standard_parameters(load("lwr4plus"))
    wanted = calibrated.regressor(q, v, a) @ chi
    old, new = (base.BaseModel(calibrated, one).regressor(q, v, a) @ (one.transform @ chi) for one in (first, second))
    assert np.allclose(new, wanted, rtol=0, atol=1e-8)
    assert np.abs(old - wanted).max() > 1e-2
    for name, line in zip(second.names, base.expressions(second)):  # R where others are in, and nowhere else
        assert name.endswith("R") == (" + " in line or " - " in line), line


def test_leaning_axis_adds_weak_directions():
    """Axis 1 at 1 mrad from the vertical: rank 43 -> 45 by columns of 0.01 N m per kg m, left out and reported."""
    chain = load("lwr4plus")
    leaning = IdentificationModel(bodies_of(chain).with_gravity(9.81 * np.array([np.sin(1e-3), 0.0, -np.cos(1e-3)])))
    first = base.find(IdentificationModel(bodies_of(chain)))
    second = base.regroup(first, leaning)
    assert base.find(leaning).b == 45
    assert second.split.singular_values[45] < 1e-12 * second.split.singular_values[0]
    names = [second.standard[k] for k in second.split.dropped]
    assert second.without_effect and {"MX1", "MY1"}.isdisjoint(second.without_effect)
    sideways = second.lost[names.index("MX1")]  # one of seven rows feels 9.81 sin(1e-3) sin(q1) per kg m
    assert np.isclose(sideways, 9.81e-3 / np.sqrt(2 * 7), rtol=0.2)


@pytest.mark.parametrize("robot", ["lwr4plus", "tx40", "ur5"])
def test_rounding_does_not_choose_columns(robot):
    """Other samples, other rounding: the same columns, the same K (so no BLAS build decides)."""
    full = from_chain(load(robot), "Ia Fv Fc off")
    first = base.find(full)
    for seed in range(1, 4):
        other = base.find(full, base.random_samples(full, 200, seed))
        assert np.array_equal(other.kept, first.kept) and other.names == first.names
        assert np.allclose(other.transform, first.transform, rtol=0, atol=1e-9)


def test_memory_is_bounded_for_any_blocks(monkeypatch):
    """Memory stays bounded, and blocks do not matter."""
    full = IdentificationModel(bodies_of(load("ur5")))
    samples = base.random_samples(full, 300)
    whole = base.r_factor(full, samples)
    monkeypatch.setattr(base, "BLOCK", 64)
    parts = base.r_factor(full, samples)
    assert np.allclose(parts.T @ parts, whole.T @ whole, rtol=0, atol=1e-9 * np.abs(whole).max() ** 2)
    sizes = []
    original = IdentificationModel.regressor

    def watched(self, *states):
        result = original(self, *states)
        sizes.append(len(result))
        return result

    monkeypatch.setattr(IdentificationModel, "regressor", watched)
    base.r_factor(full, samples)
    assert max(sizes) == 64 and sum(sizes) == 300


@pytest.mark.parametrize("name", ["motley", "motley with payload"])
def test_prismatic_joints_and_tilted_gravity(name):
    """The rank of the whole matrix is what the search in order finds, and the prediction stays exact."""
    chain = motley()
    bodies = with_payload(bodies_of(chain), np.eye(4)) if "payload" in name else bodies_of(chain)
    full = IdentificationModel(bodies)
    result = base.find(full)
    q, v, a = states(5, 300)
    cases = (
        [full.regressor(q, v, a), full.regressor(q, v, a, carried=())]
        if "payload" in name
        else [full.regressor(q, v, a)]
    )
    matrix = np.concatenate([case.reshape(-1, full.p) for case in cases])
    assert result.b == np.linalg.matrix_rank(matrix, tol=1e-9 * np.linalg.norm(matrix))
    chi = physical(bodies.count).ravel()
    for case in cases:
        assert np.allclose(case[:, :, result.kept] @ (result.transform @ chi), case @ chi, rtol=0, atol=1e-10)
    moved = [k for k in range(50, 60) if k in result.kept] if "payload" in name else range(10)
    assert "payload" not in name or len(moved) == 10


def test_richer_friction_has_own_columns():
    """Richer friction has columns of its own."""
    chain = load("ur5")
    rich = (
        friction.term("Fva2", "speed", 1),
        friction.term("Ft2", "load", 1, 0.01),
        *friction.offered("presliding", 1, RecordedRange(0.01, 1.0, 1.0, 2.0))[:2],
    )
    plain = IdentificationModel(bodies_of(chain), drives.standard(["Ia Fv Fc off"] * 6))
    full = IdentificationModel(bodies_of(chain), plain.terms + rich)
    assert base.find(full).b == base.find(plain).b + 4


def test_base_of_another_model_is_refused():
    with pytest.raises(CalibError, match="another model"):
        base.BaseModel(arm(MOTOR), found(BOTH))
    with pytest.raises(CalibError, match="another model"):
        base.regroup(found(BOTH), arm(MOTOR))
