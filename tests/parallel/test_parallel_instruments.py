"""Instrumental variables for parallel robots: their closed loop is simulated."""

from dataclasses import replace

import numpy as np
import pytest
from platform_sines import fitted, sines, truth

from calib.data.recordings.recording import Recording
from calib.errors import CannotSimulate, UsageError
from calib.identification.closed_loop.controllers import Reference, pd
from calib.identification.closed_loop.simulation import Sensing
from calib.identification.identify_options import parse_options
from calib.identification.loop import LoopController
from calib.parallel.identification import identify_parallel
from calib.parallel.mechanism.closure import closed
from calib.parallel.mechanism.geometric_fit import changed, visible_directions
from calib.parallel.mechanism.parallel_model import along
from calib.parallel.robots import ParallelMechanism, find


def gains(name: str, kp: float, kd: float) -> LoopController:
    ones = np.ones(find(name).chain.n)
    return pd(kp * ones, kd * ones)


def asked(name: str, seconds: float, rate: float = 1000.0) -> Reference:
    """Return a reference of the actuators: sines of the platform's coordinates."""
    known, t = find(name).mechanism, np.arange(int(seconds * rate)) / rate
    size = 0.05 * (known.robot.upper - known.robot.lower)
    motion = along(known, *sines(t, (0.5, 1.1, 1.9, 2.7), size, np.random.default_rng(1)))
    own = known.robot.actuated
    return Reference(t, motion.posture.q[:, own], motion.v[:, own], motion.a[:, own])


def logs(name: str, kp: float, kd: float, noise: float, seconds: float) -> list[Recording]:
    """Return recordings without and with the payload, with noise of the encoders that the controller acts on."""
    known, result = find(name).mechanism, []
    model, values = truth(known, "Ia Fv Fc")
    for k, carried in enumerate(((), ("5",))):
        reference, plant = asked(name, seconds), model.plant(values).carrying(carried)
        run = plant.run(gains(name, kp, kd), reference, Sensing(noise, sigma_tau=0.1), k)
        given = (run.t, run.measured, run.tau, "torque", known.robot.joint_names)
        result.append(Recording(*given, q_ref=reference.q, file="load.csv" if carried else "empty.csv"))
    return result


def options(method: str, kp: float, kd: float, cutoff: float, **more):
    return parse_options({
        "method": method, "drives": "Ia Fv Fc", "v0": 0.05, "prior": "none", "essential": "none",
        "loop": {"controller": "pd", "kp": kp, "kd": kd, "rate": 1000.0}, "payload": {"5": {}},
        "filter": {"cutoff": cutoff, "band": cutoff / 2}, "files": {"load.csv": {"payload": ["5"]}},
    } | more)  # fmt: skip


def away(found, name: str) -> np.ndarray:
    """Return the errors of an estimate (b,) in its standard deviations."""
    model, values = truth(find(name).mechanism, "Ia Fv Fc")
    known, base = dict(zip(model.names, values)), found.found.base
    return (found.estimate.values - base.transform @ [known[k] for k in base.standard]) / found.estimate.sigma


@pytest.mark.slow  # the simulation's kernel takes 14 s to compile
def test_instruments_cure_bias_of_the_loop():
    """DualV, 0.7 mrad of noise in the loop: least squares is beyond 5 σ, with instruments 95 % of 28 are in 2 σ."""
    recordings, robot = logs("dualv", 1000.0, 8.0, 7e-4, 6.0), find("dualv")
    for method, beyond in (("wls", True), ("iv", False), ("didim", False)):
        found = identify_parallel(robot, recordings, options=options(method, 1000.0, 8.0, 60.0))
        errors = np.abs(away(found, "dualv"))
        assert np.any(errors > 5.0) == beyond and (np.mean(errors < 2.0) > 0.95) != beyond
        codes = {one.code for one in found.noticed}
        assert ("least-squares-biased" in codes) == beyond and "loop-gains-off" not in codes


@pytest.mark.slow
@pytest.mark.parametrize("method", ["cloe", "clie"])
def test_output_error_recovers_robot(method):
    """Five-bar, 1 s, without the payload, with noise of the encoders in the loop: 50 rows for 15 parameters."""
    (recording, _), robot = logs("fivebar", 4000.0, 40.0, 1e-5, 1.0), find("fivebar")
    found = identify_parallel(
        robot, [recording], options=options(method, 4000.0, 40.0, 60.0, payload={}, files={}, essential="none")
    )
    errors = np.abs(away(found, "fivebar"))
    assert len(errors) > 10 and np.mean(errors < 2.0) > 0.85 and errors.max() < 4.0


@pytest.mark.slow
def test_other_controllers_gains_are_noticed():
    """Gains of another controller are noticed."""
    recordings = logs("dualv", 3000.0, 30.0, 1e-5, 3.0)
    found = identify_parallel(find("dualv"), recordings, options=options("iv", 1500.0, 30.0, 40.0))
    assert {"loop-gains-off", "loop-not-followed"} & {one.code for one in found.noticed}


@pytest.mark.slow
@pytest.mark.parametrize("method", ["iv", "didim"])
def test_geometry_share_is_the_derivative(method):
    """Derivative of the estimate by the loops' constants, against identifications on two geometries: to 2 % in σ."""
    robot, recordings = fitted(find("fivebar").mechanism), logs("fivebar", 4000.0, 40.0, 1e-4, 1.5)
    chosen = options(method, 4000.0, 40.0, 40.0)
    chosen = replace(chosen, settings=replace(chosen.settings, loop=replace(chosen.settings.loop, timing="stated")))
    found, parameters = identify_parallel(robot, recordings, options=chosen), robot.covariance.of(robot.mechanism)
    directions = visible_directions(robot.mechanism, parameters)
    step = directions @ np.random.default_rng(1).normal(size=directions.shape[1])
    step *= 1e-4 / np.linalg.norm(step)
    moved = (ParallelMechanism(closed(changed(robot.chain, parameters, x)), robot.source) for x in (step, -step))
    ends = [identify_parallel(one, recordings, options=chosen).estimate.values for one in moved]
    by_hand, sigma = (ends[0] - ends[1]) / 2.0, found.carried.sigma_torque
    ours = found.carried.sensitivity[:, : len(parameters)] @ step
    assert np.linalg.norm((ours - by_hand) / sigma) < 0.02 * np.linalg.norm(by_hand / sigma)


@pytest.mark.slow
def test_stiff_simulation_meets_equations():
    """Held torques meet those of the model as 1 / rate; friction that no single step could follow does not chatter."""
    known, wrong = find("fivebar").mechanism, []
    model, values = truth(known, "Ia Fv Fc")
    for rate in (1000.0, 4000.0):
        run = model.plant(values).run(gains("fivebar", 4000.0, 40.0), asked("fivebar", 1.0, rate))
        part = slice(len(run.t) // 5, None)
        needed = model.torque(values, run.q[part], run.v[part], run.a[part])
        mean = 0.5 * (run.torque[part] + run.torque[part.start - 1 : -1])
        wrong.append(np.abs(mean - needed).max() / np.abs(needed).max())
    assert wrong[0] < 0.05 and wrong[1] < 0.5 * wrong[0]
    stiff = replace(model, terms=tuple(replace(x, settings=(1e-4,)) if x.shape == "sign" else x for x in model.terms))
    many = np.where([name.startswith("Fc") for name in model.names], 3.0, values)
    reference = asked("fivebar", 0.5)
    still = replace(reference, q=0.0 * reference.q + reference.q[0], v=0.0 * reference.v, a=0.0 * reference.a)
    run = stiff.plant(many).run(gains("fivebar", 4000.0, 40.0), still)
    assert np.abs(np.diff(run.q[-100:], axis=0)).max() < 1e-6


@pytest.mark.slow
def test_impossible_simulation_is_said():
    """What no simulation can follow is said."""
    model, values = truth(find("dualv").mechanism, "Ia Fv Fc")
    with pytest.raises(CannotSimulate, match="not positive definite"):
        model.plant(-values).run(gains("dualv", 1000.0, 8.0), asked("dualv", 0.2))
    with pytest.raises(CannotSimulate, match="state its v0, above 0"):
        replace(model, terms=tuple(replace(x, settings=(0.0,) * len(x.settings)) for x in model.terms)).plant(
            values
        ).run(gains("dualv", 1000.0, 8.0), asked("dualv", 0.2))


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"method": "ekf"}, r"parallel robots take ols, wls.*iv, didim, pc-iv, pc-didim, cloe, clie"),
        ({"method": "cloe", "rows": "power"}, r"rows = 'power' is not supported"),
        ({"method": "gtls"}, "differentiates the torques of a serial arm"),
        ({"rows": "power"}, r"rows = 'power' is not supported; methods that support it: ols, wls"),
        ({"loop": None}, r"needs a \[loop\]|needs the closed loop"),
    ],
)
def test_methods_need_a_simulation(more, said):
    """Methods and rows without a simulation are refused."""
    reference = asked("dualv", 1.0)
    given = (reference.t, reference.q, 10.0 * np.sin(9.0 * reference.q), "torque", find("dualv").chain.joint_names)
    table = {"method": "iv", "loop": {"controller": "pd", "kp": 1.0, "kd": 1.0}} | more
    with pytest.raises(UsageError, match=said):
        identify_parallel(find("dualv"), [Recording(*given, q_ref=reference.q, file="run")], options=parse_options(
            {key: value for key, value in table.items() if value is not None}
        ))  # fmt: skip
