"""An arm of three joints with known dynamics, moved along Fourier series, and its recordings."""

from functools import cache, lru_cache
from pathlib import Path

import numpy as np
import pytest

from calib.data.recordings.recording import Recording
from calib.data.signals.motion import FilterOptions, make_motion
from calib.dynamics import drives
from calib.dynamics.bodies import bodies_of, with_payload
from calib.dynamics.drives import DriveTerm
from calib.dynamics.idim import IdentificationModel
from calib.identification.identify import chain_states, common_decimator, find_base
from calib.identification.methods.method import IdentificationProblem
from calib.identification.rows import Case, make_case, observe
from calib.identification.settings import IdentificationSettings, make_model
from calib.robot import description
from calib.robot.chain import Chain, Element, Joint

N = 3
RATE = 200.0
INERTIAS = np.array(
    [
        [0.05, 0.001, 0.002, 0.06, 0.003, 0.08, 0.10, -0.05, 0.20, 4.0],
        [0.04, 0.002, -0.01, 0.30, 0.002, 0.31, 0.90, 0.05, 0.10, 3.0],
        [0.02, 0.001, 0.004, 0.09, 0.001, 0.10, 0.30, 0.04, -0.05, 1.5],
    ]
)
DRIVES = {"Ia": (0.5, 0.4, 0.1), "Fv": (2.0, 1.5, 0.6), "Fc": (3.0, 2.5, 0.8), "off": (0.3, -0.2, 0.1)}
PAYLOAD = (0.02, 0.0, 0.001, 0.02, 0.0, 0.01, 0.1, 0.05, 0.2, 2.0)


def arm() -> Chain:
    """Return a shoulder that turns about the vertical and two joints that lift."""
    elements = (
        Element("turn", "rz", 0.0, 0, 0),
        Element("up", "rx", np.pi / 2, 1),
        Element("shoulder", "rz", 0.0, 1, 1),
        Element("upper", "tx", 0.5, 2),
        Element("elbow", "rz", 0.0, 2, 2),
        Element("fore", "tx", 0.4, 3),
    )
    joints = tuple(Joint(f"joint{j + 1}", "revolute", -3.0, 3.0, 5.0, 300.0) for j in range(N))
    return Chain("planted", joints, elements, inertias=INERTIAS)


def model(terms: tuple[DriveTerm, ...] = (), payload: bool = False) -> IdentificationModel:
    """Return the truth's model; v0 of the sign is the default."""
    bodies = bodies_of(arm())
    if payload:
        bodies = with_payload(bodies, np.asarray(arm().tail), "load", on=N - 1)
    return IdentificationModel(bodies, (*drives.standard(["Ia Fv Fc off"] * N), *terms))


def truth(extra: dict[str, float] | None = None, payload: bool = False) -> np.ndarray:
    """Return the true values in the model's order."""
    standard = [DRIVES[name][joint] for joint in range(N) for name in ("Ia", "Fv", "Fc", "off")]
    load = PAYLOAD if payload else ()
    return np.array([*INERTIAS.ravel(), *load, *standard, *(extra or {}).values()])


def motion(seed: int, duration: float = 20.0, harmonics: int = 6) -> tuple[np.ndarray, ...]:
    """Return t (N,), q, v, a (N, 3) of a Fourier series with a period of ten seconds."""
    rng = np.random.default_rng(seed)
    t = np.arange(int(duration * RATE)) / RATE
    order = np.arange(1, harmonics + 1)
    omega = 2 * np.pi / 10.0 * order
    sines, cosines = rng.normal(size=(2, N, harmonics)) * 0.5 / np.sqrt(order)
    s = np.sin(np.outer(t, omega))
    c = np.cos(np.outer(t, omega))
    q = s @ sines.T + c @ cosines.T
    v = (c * omega) @ sines.T - (s * omega) @ cosines.T
    a = -(s * omega**2) @ sines.T - (c * omega**2) @ cosines.T
    return t, q, v, a


def torques(
    q: np.ndarray,
    v: np.ndarray,
    a: np.ndarray,
    terms: tuple[DriveTerm, ...] = (),
    values: dict[str, float] | None = None,
    payload: bool = False,
) -> np.ndarray:
    """Return the true torques (N, 3); load-dependent friction feels the bodies' torque."""
    plain = model(payload=payload)
    bodies = 10 * plain.bodies.count
    load = plain.regressor(q, v, a)[:, :, :bodies] @ truth(payload=payload)[:bodies]
    full = model(terms, payload)
    return full.regressor(q, v, a, load) @ truth(values, payload)


@cache
def _played(
    seed: int, terms: tuple[DriveTerm, ...], values: tuple, payload: bool, motion_settings: tuple
) -> np.ndarray:
    """Return the true torques (N, 3) of a motion."""
    _, q, v, a = motion(seed, **dict(motion_settings))
    return torques(q, v, a, terms, dict(values), payload)


def series(
    seed: int,
    noise: float = 0.2,
    terms: tuple[DriveTerm, ...] = (),
    values: dict[str, float] | None = None,
    payload: bool = False,
    **motion_settings,
) -> dict[str, np.ndarray]:
    """Return t, q and tau as a controller would log them, torque noise white."""
    t, q = motion(seed, **motion_settings)[:2]
    hashable_values = tuple((values or {}).items())
    tau = _played(seed, terms, hashable_values, payload, tuple(motion_settings.items()))
    rng = np.random.default_rng(1000 + seed)
    return {"t": t, "q": q, "tau": tau + noise * rng.normal(size=tau.shape)}


def case(name: str, seed: int, carried: tuple[str, ...] = (), band: float = 10.0, gains=None, **settings) -> Case:
    """Return a recorded case of `series` with other settings; with gains [N m/A] its currents."""
    values = tuple((settings.pop("values", None) or {}).items())
    hashable_gains = None if gains is None else tuple(gains)
    return _case(name, seed, carried, band, hashable_gains, values, tuple(settings.items()))


@lru_cache(maxsize=32)
def _case(
    name: str,
    seed: int,
    carried: tuple[str, ...],
    band: float,
    gains: tuple[float, ...] | None,
    values: tuple[tuple[str, float], ...],
    settings: tuple[tuple[str, object], ...],
) -> Case:
    """Return a case; tests share it, as none changes it in place."""
    log = series(seed, values=dict(values), payload=bool(carried), **dict(settings))
    effort = log["tau"]
    if gains is not None:
        effort = effort / np.asarray(gains)
    recording = Recording(log["t"], log["q"], effort, "torque", ("joint1", "joint2", "joint3"), file=name)
    return make_case(name, make_motion(recording, FilterOptions(cutoff=30.0, band=band)), carried=carried)


def write(folder: Path, name: str, seed: int, **arrays) -> Path:
    """Write a recording as a NumPy archive, with more arrays or others."""
    path = folder / name
    np.savez(path, **{**series(seed), **arrays})
    return path


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    """Return the planted arm's robot.toml."""
    return description.write(tmp_path / "planted.toml", arm())


@pytest.fixture(scope="module")
def problem() -> IdentificationProblem:
    """Return a problem of identification of the planted arm."""
    settings = IdentificationSettings()
    cases = [case("a", 0)]
    model = make_model(arm(), settings)
    decimator = common_decimator(cases, settings)
    base = find_base(model, cases, chain_states(arm(), model))
    rows = tuple(observe(model, base.kept, case, decimator) for case in cases)
    terms = [None if k < model.inertial else model.columns[k - model.inertial] for k in base.kept]
    return IdentificationProblem(model, base, cases, decimator, rows, tuple(terms), np.full(base.b, -1))
