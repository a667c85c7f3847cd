"""The power model of serial arms: energies whose derivative is the power, one row per sample, weights by recording."""

import csv

import numpy as np
import practice
import pytest
from arms import motley
from scipy.spatial.transform import Rotation

from calib.cli import run
from calib.data.recordings.recording import Recording
from calib.data.signals.filtering import decimate
from calib.data.signals.motion import FilterOptions, make_motion
from calib.dynamics.bodies import PRISMATIC, REVOLUTE, Bodies, bodies_of, with_payload
from calib.dynamics.drives import coupled, standard
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.torque_rows import POWER
from calib.identification.identify import common_decimator, identify_model
from calib.identification.rows import make_case, observe
from calib.identification.settings import IdentificationSettings


def model(n: int, drives: str = "Ia"):
    terms = (*standard([drives] * n, v0=0.5), *coupled(n - 2, n - 1, v0=0.5)[:1])
    return IdentificationModel(bodies_of(motley()), terms, POWER)


def motion(t: np.ndarray, n: int, seed: int = 0):
    """Return q, v, a (N, n) of a sum of sines."""
    rng = np.random.default_rng(seed)
    a, phase, w = rng.normal(size=(3, n)) * 0.4, rng.uniform(0, 6, (3, n)), rng.uniform(0.7, 4.0, (3, n))
    angle = w[:, None] * t[None, :, None] + phase[:, None]
    q = np.sum(a[:, None] * np.sin(angle), axis=0)
    v = np.sum((a * w)[:, None] * np.cos(angle), axis=0)
    return q, v, -np.sum((a * w**2)[:, None] * np.sin(angle), axis=0)


def test_energy_derivative_is_the_power():
    """Of every column: bodies, rotors, a rotor that two joints share; under gravity, with prismatic joints."""
    n = motley().n
    t = np.linspace(0.0, 1.0, 4001)
    q, v, a = motion(t, n)
    own = model(n)
    rising = np.gradient(own.energy_columns(q, v), t, axis=0)[1:-1]
    power = own.regressor(q, v, a)[1:-1, 0]
    assert np.allclose(rising, power, rtol=0, atol=1e-5 * np.abs(power).max())


@pytest.mark.slow
def test_power_needs_no_accelerations():
    """Base parameters within their sigmas, from two recordings one of which is ten times as noisy."""
    n, away = motley().n, []
    own = model(n, "Ia Fv")
    truth = np.abs(np.random.default_rng(5).normal(size=own.p))
    for seed in range(4):
        cases = []
        for k, noise in enumerate((0.05, 0.5)):
            t = np.arange(4000) / 200.0
            q, v, a = motion(t, n, 10 * seed + k)
            joints = IdentificationModel(own.bodies, own.terms)
            tau = joints.torque(truth, q, v, a)
            tau += noise * np.random.default_rng(seed + 100 * k).normal(size=tau.shape)
            recording = Recording(t, q, tau, "torque", motley().joint_names, file=f"run{k}")
            cases.append(make_case(f"run{k}", make_motion(recording, FilterOptions(cutoff=20.0, band=8.0)), POWER))
        settings = IdentificationSettings(prior="none", essential="none", torque_rows=POWER)
        found = identify_model(own, cases, settings)
        estimate = found.fitted.estimate
        away.append((estimate.values - found.base.transform @ truth) / estimate.sigma)
        assert found.fitted.std[1] > 4.0 * found.fitted.std[0]
    assert 0.5 < np.sqrt(np.mean(np.concatenate(away) ** 2)) < 2.0


def body_frames(bodies: Bodies, q: np.ndarray) -> np.ndarray:
    """Return the poses (N, B, 4, 4) of the bodies, by the product of placements and turns about their axes."""
    frames = np.zeros((len(q), bodies.count, 4, 4))
    for b, parent in enumerate(bodies.parents):
        before = frames[:, parent] if parent >= 0 else np.broadcast_to(np.eye(4), (len(q), 4, 4))
        moved = np.broadcast_to(np.eye(4), (len(q), 4, 4)).copy()
        direction = np.eye(3)[bodies.axes[b]]
        size = bodies.scales[b] * q[:, bodies.coordinates[b]]
        if bodies.kinds[b] == REVOLUTE:
            moved[:, :3, :3] = Rotation.from_rotvec(size[:, None] * direction).as_matrix()
        elif bodies.kinds[b] == PRISMATIC:
            moved[:, :3, 3] = size[:, None] * direction
        frames[:, b] = before @ bodies.placements[b] @ moved
    return frames


def energies(bodies: Bodies, q: np.ndarray, v: np.ndarray, step: float = 1e-6) -> np.ndarray:
    """Return the factors (N, 10 B) of XX … M in the energy Σ ½ ωᵀJω + mcᵀ(u × ω) + ½ m u² - mgᵀp, u and ω in a body."""
    after, frames, before = (body_frames(bodies, q + sign * step * v) for sign in (1, 0, -1))
    change = np.swapaxes(frames[..., :3, :3], -1, -2) @ (after - before)[..., :3, :] / (2 * step)
    ω = np.stack([change[..., 2, 1], change[..., 0, 2], change[..., 1, 0]], axis=-1)
    u = change[..., 3]
    x, y, z = np.moveaxis(ω, -1, 0)
    moments = np.stack([x * x / 2, x * y, x * z, y * y / 2, y * z, z * z / 2], axis=-1)
    first = np.cross(u, ω) - np.swapaxes(frames[..., :3, :3], -1, -2) @ bodies.gravity
    mass = np.sum(u * u, axis=-1) / 2 - frames[..., :3, 3] @ bodies.gravity
    return np.concatenate([moments, first, mass[..., None]], axis=-1).reshape(len(q), -1)


def test_payload_stacks_as_written():
    """[Wa 0; Wb Wl] (Briot, Gautier & Krut 2013, eq. 22), by energies written out here, one row for each recording."""
    chain = motley()
    own = IdentificationModel(with_payload(bodies_of(chain), np.asarray(chain.tail), "load", on=4), (), POWER)
    cases, expected, stacked = [], [], []
    options = FilterOptions(cutoff=40.0, band=8.0)
    for number, carried in enumerate(((), ("load",))):
        t = np.arange(3000) / 400.0
        q, _, _ = motion(t, chain.n, number)
        tau = np.zeros_like(q)
        recording = Recording(t, q, tau, "torque", chain.joint_names, file=f"run{number}")
        cases.append(make_case(f"run{number}", make_motion(recording, options), POWER, carried=carried))
    decimator = common_decimator(cases, IdentificationSettings(torque_rows=POWER))
    for number, case in enumerate(cases):
        part = observe(own, np.arange(own.p), case, decimator).by_recording(number, 2)
        stacked.append(part.matrix)
        moving = case.motion
        rising = np.gradient(energies(own.bodies, moving.q, moving.v), 1.0 / moving.rate, axis=0)
        if number == 0:
            rising[:, 50:] = 0.0
        expected.append(decimate(rising, decimator, moving.segment))
    for number in range(2):
        observed = stacked[number]
        assert not observed[:, 1 - number].any()
        inner = slice(20, -20)
        size = np.abs(expected[number][inner]).max()
        assert np.allclose(observed[inner, number], expected[number][inner], atol=2e-3 * size)
    assert not stacked[0][:, :, 50:].any()
    assert np.abs(stacked[1][:, 1, 50:]).max() > 0.0


@pytest.mark.slow
@pytest.mark.parametrize(("robot", "payload"), [("tx40", 2.8), ("lwr4plus", 3.28)])
def test_two_loads_give_the_payload_by_power(robot, payload, tmp_path, monkeypatch):
    """`calib identify` on a recording without and one with the load [kg] that examples/practice.py attaches."""
    monkeypatch.chdir(tmp_path)
    practice.log("empty.csv", robot, "1")
    practice.log("loaded.csv", robot, "3", load="load")
    options = 'rows = "power"\nessential = "none"\n[payload.tool]\n[files."loaded.csv"]\npayload = ["tool"]\n'
    (tmp_path / "power.toml").write_text(options)
    command = ["identify", robot, "empty.csv", "loaded.csv", "--options", "power.toml", "--no-plots", "--out", "out"]
    assert run(command) in (0, 1)
    with open("out/estimate.csv", encoding="utf-8") as file:
        estimate = {row["name"]: row for row in csv.DictReader(file)}
    mass, sigma = float(estimate["Mtool"]["value"]), float(estimate["Mtool"]["sigma"])
    assert abs(mass - payload) < 3.0 * sigma < 0.3
