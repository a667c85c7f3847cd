"""Drive terms: what each column says, their slopes, couplings, friction with memory."""

import numpy as np
import pytest
from arms import motley, states
from differences import check

from calib.dynamics import drives
from calib.dynamics.bodies import bodies_of
from calib.dynamics.idim import IdentificationModel, friction_states, from_chain
from calib.dynamics.torque_rows import BOTH, DRIVE, LINK, MOTOR, torque_rows
from calib.errors import CalibError
from calib.robot.library import load

TX40 = load("tx40")
SMOOTH = (
    drives.standard(["Ia Fv Fc off"] * 6, v0=0.5)
    + drives.coupled(4, 5, v0=0.5)
    + (drives.term("Fva1", "speed", 0),)
    + (drives.term("Fvc2", "cubic", 1),)
    + (drives.term("Fvr3", "root", 2, 0.3),)
    + (drives.term("Fs4", "stribeck", 3, 0.4, 2.0, 0.5),)
    + tuple(drives.term(f"{shape}{k}", shape, 4, k, 0.7) for k in (3, 5) for shape in ("sine", "cosine"))
)


def column(model, name, *motion, **more):
    return model.regressor(*motion, **more)[:, :, model.names.index(name)]


def test_every_shape_has_its_compiled_code():
    """Every shape has a compiled code of its own."""
    from calib.dynamics import shape_kernels
    from calib.dynamics.shapes import SHAPES

    assert sorted(getattr(shape_kernels, name.upper()) for name in SHAPES) == list(range(len(SHAPES)))


def test_standard_columns():
    q, v, a = states(6)
    model = IdentificationModel(bodies_of(TX40), drives.standard(["Ia Fv Fc off"] * 6, v0=0.0))
    assert model.p == 84 and model.names[60:64] == ("Ia1", "Fv1", "Fc1", "off1")
    assert model.units[60:64] == ("kg m²", "N m s/rad", "N m", "N m")
    for name, wanted in (("Ia", a), ("Fv", v), ("Fc", np.sign(v)), ("off", np.ones_like(v))):
        found = column(model, f"{name}4", q, v, a)
        assert np.array_equal(found[:, 3], wanted[:, 3])
        assert not np.any(np.delete(found, 3, axis=1))


def test_smoothing_is_the_stated_one():
    q, v, a = states(6)
    model = IdentificationModel(bodies_of(TX40), drives.standard(["Fc"] * 6, v0=0.2))
    assert np.allclose(column(model, "Fc2", q, v, a)[:, 1], np.tanh(v[:, 1] / 0.2), rtol=0, atol=1e-15)


def test_coupled_wrist():
    """tau5 += Iam6 a6 + Fvm6 v6 + Fcm6 sign(v5 + v6), tau6 += Iam6 a5 + Fvm6 v5 + Fcm6 sign(v5 + v6)."""
    q, v, a = states(6)
    model = IdentificationModel(bodies_of(TX40), drives.coupled(4, 5, v0=0.0))
    assert model.names[-3:] == ("Iam6", "Fvm6", "Fcm6")
    sign = np.sign(v[:, 4] + v[:, 5])
    for name, fifth, sixth in (("Iam6", a[:, 5], a[:, 4]), ("Fvm6", v[:, 5], v[:, 4]), ("Fcm6", sign, sign)):
        found = column(model, name, q, v, a)
        assert np.array_equal(found[:, 4], fifth) and np.array_equal(found[:, 5], sixth)
        assert not found[:, :4].any()


SIDED = drives.standard(["Ia Fvl Fcl offl Fvm Fcm offm"] * 5, v0=0.5)
MODELS = {rows.name: IdentificationModel(bodies_of(motley()), SIDED, rows) for rows in (MOTOR, BOTH, DRIVE, LINK)}
MODELS["every smooth term"] = IdentificationModel(bodies_of(TX40), SMOOTH)


@pytest.mark.parametrize("name", MODELS)
def test_gradient_of_the_model(name):
    model, rng = MODELS[name], np.random.default_rng(1)
    x, weights = rng.normal(size=3 * model.n), rng.normal(size=(1, model.rows, model.p))

    def weighted(x):
        return np.sum(weights * model.regressor(*x.reshape(3, 1, -1)))

    slopes = model.regressor_gradient(*x.reshape(3, 1, -1), weights)
    check(weighted, np.concatenate([g[0] for g in slopes]), x)


def test_terms_that_depend_on_more_say_so():
    q, v, a = states(6)
    model = IdentificationModel(bodies_of(TX40)).with_terms(
        drives.term("Ft2", "load", 1, 0.01), drives.term("Fvt2", "load_velocity", 1)
    )
    assert model.with_load() == ("Ft2", "Fvt2")
    with pytest.raises(CalibError, match="'Ft2' needs the transmitted torque"):
        model.regressor(q, v, a)
    with pytest.raises(CalibError, match="no derivatives"):
        model.regressor_gradient(q, v, a, np.zeros((len(q), 6, model.p)))
    torque = np.random.default_rng(0).normal(size=q.shape)
    found = column(model, "Fvt2", q, v, a, load=torque)
    assert np.allclose(found[:, 1], np.abs(torque[:, 1]) * v[:, 1], rtol=0, atol=1e-15)


def test_stop_operator_is_coulomb_and_spring():
    """Stiff within a width of the turning point, ±1 beyond; the loop closes and remembers its side."""
    model = IdentificationModel(bodies_of(TX40), (drives.term("Fp3.1", "presliding", 2, 0.1, 0.01),))
    x = np.concatenate([np.linspace(0, 1, 101), np.linspace(1, 0.95, 6)[1:], np.linspace(0.95, 0, 96)[1:]])
    q = np.zeros((len(x), 6))
    q[:, 2] = x
    state = friction_states(model, q)[0]
    assert np.allclose(state[:11], np.arange(11) / 10) and np.all(state[11:101] == 1.0)
    assert np.isclose(state[105], 0.5) and np.all(state[125:] == -1.0)
    whole = column(model, "Fp3.1", q, 0 * q, 0 * q)[:, 2]
    later = model.regressor(q[150:], 0 * q[150:], 0 * q[150:], states=state[None, 150:])[:, 2, -1]
    assert np.array_equal(whole, state) and np.array_equal(later, state[150:])
    v = np.gradient(q, axis=0)
    sliding = np.abs(state) == 1.0
    off = column(
        IdentificationModel(bodies_of(TX40), (drives.term("Fp3.1", "presliding", 2, 0.1, 0.0),)), "Fp3.1", q, v, 0 * q
    )[:, 2]
    assert np.array_equal(off, state - np.sign(v[:, 2])) and np.all(off[sliding & (np.abs(v[:, 2]) > 0)] == 0.0)


def test_ripple_fades_with_speed():
    q, v, a = states(6)
    model = IdentificationModel(bodies_of(TX40), (drives.term("Rs", "sine", 0, 241.0, 0.5),))
    wanted = np.sin(241 * q[:, 0]) / (1 + (v[:, 0] / 0.5) ** 2)
    assert np.allclose(column(model, "Rs", q, v, a)[:, 0], wanted, rtol=0, atol=1e-14)


def test_units_of_a_prismatic_joint():
    terms = drives.standard(["Ia Fv Fc"] * 2, linear=[False, True])
    assert [one.unit for one in terms] == ["kg m²", "N m s/rad", "N m", "kg", "N s/m", "N"]


def test_model_of_a_chain():
    model = from_chain(motley(), "Ia Fc", payload=np.eye(4))
    assert model.names[-10:] == ("Ia1", "Fc1", "Ia2", "Fc2", "Ia3", "Fc3", "Ia4", "Fc4", "Ia5", "Fc5")
    assert model.units[-8:-6] == ("kg", "N") and model.names[50] == "XX6"
    assert from_chain(TX40, ["Ia"] * 5 + [""]).p == 65
    with pytest.raises(CalibError, match="has 6 joints, but drive terms are given for 2"):
        from_chain(TX40, ["Ia", "Ia"])


def test_absent_payload_has_no_columns():
    q, v, a = states(5)
    model = from_chain(motley(), "", payload=np.eye(4))
    loaded, empty = model.regressor(q, v, a), model.regressor(q, v, a, carried=())
    assert loaded[:, :, 50:].any() and not empty[:, :, 50:].any()
    assert np.array_equal(loaded[:, :, :50], empty[:, :, :50])
    assert np.array_equal(model.regressor(q, v, a, carried=("6",)), loaded)
    with pytest.raises(CalibError, match="no payload 'box' in the model; it has 6"):
        model.regressor(q, v, a, carried=("box",))


def test_stacking_copies_nothing():
    """All samples of row 1, of row 2, …: torques stack as ``tau.T.ravel()``."""
    q, v, a = states(6)
    regressor = IdentificationModel(bodies_of(TX40), drives.standard(["Ia Fv"] * 6)).regressor(q, v, a)
    matrix = regressor.transpose(2, 1, 0).reshape(regressor.shape[2], -1).T
    assert np.shares_memory(matrix, regressor) and matrix.flags.f_contiguous
    assert np.array_equal(matrix[len(q) * 2 + 3], regressor[3, 2])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: drives.standard(["Ia Fx"]), "joint 1: drive term 'Fx' is none of Ia"),
        (lambda: drives.term("F", "sign", 0), r"needs \(v0\)"),
        (lambda: drives.term("F", "curly", 0), "shape 'curly' is not one of"),
        (lambda: drives.DriveTerm("F", "one", (), side="left"), "side 'left', expected 'link' or 'motor'"),
        (lambda: IdentificationModel(bodies_of(TX40), drives.standard(["Ia"]) * 2), "'Ia1' occurs twice"),
        (lambda: IdentificationModel(bodies_of(TX40), drives.standard(["Ia"] * 7)), "'Ia7' refers to a joint that"),
        (lambda: torque_rows("torque"), "kind 'torque' is not one of"),
    ],
)
def test_bad_terms_are_named(make, message):
    with pytest.raises(CalibError, match=message):
        make()
