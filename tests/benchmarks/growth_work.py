"""The pieces of work that `growth.py` measures, each in a process of its own: python growth_work.py NAME SIZE.

A piece of work is a function of the size that makes its input and returns what is to be measured. Printed is
``{"cpu": s, "memory": MB}``: processor time of the work without making its input (the least of several runs where one
is short), and the peak memory of the process; of a command, those of the command's own process, start included.
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
SHORT, LONG = 1.0, 5.0  # [s] of processor time: work is repeated for so long; work that takes longer is done once
PARAMETERS = {13: 3, 20: 5, 25: 7, 35: 10, 49: 15, 65: 20, 93: 30}  # identifiable ones of `arm`s, and their joints
AT_ONCE = 10_000  # rows of which input is made at a time; samples of chains of growing length
BLOCK = 500_000  # numbers of a regressor filled at a time, which the processor's cache holds
LANES = 64  # samples side by side in the kernels: blocks are of multiples


class Command(NamedTuple):
    """A command of calib whose own process is measured."""

    words: list[str]


def arm(n: int):
    """Return an arm of n joints in random modified Denavit–Hartenberg rows, every third prismatic, with inertias."""
    from arms import physical

    from calib.robot.chain import Chain, Element, Joint

    random, joints, elements = np.random.default_rng(n), [], []
    for j in range(n):
        slides = j % 3 == 2
        joints.append(Joint(f"joint{j + 1}", "prismatic" if slides else "revolute", -1.0, 1.0))
        amounts = {"rx": random.choice([-1.0, 0.0, 1.0]) * np.pi / 2, "tx": 0.2, "rz": 0.3, "tz": 0.2}
        moving = "tz" if slides else "rz"
        elements += [
            Element(f"{axis}{j + 1}", axis, amount, j, j if axis == moving else None)
            for axis, amount in amounts.items()
        ]  # fmt: skip
    return Chain(f"arm{n}", tuple(joints), tuple(elements), inertias=physical(n))


def measured(nominal, count: int):
    """Return a cell with another arm than the nominal one, and `count` positions measured there (σ 0.05 mm)."""
    from planted import cell, perturb

    from calib.data.poses.measurements import Positions
    from calib.geometry.installation import see
    from calib.robot.calibrated import evaluate
    from calib.robot.chain import random_joints

    random = np.random.default_rng(1)
    truth = cell(perturb(nominal, 1, 0.5e-3, 1e-3), 1)
    q = random_joints(nominal, count, random)
    parts = [q[i : i + AT_ONCE] for i in range(0, count, AT_ONCE)]
    tool = np.zeros(AT_ONCE, dtype=int)
    seen = [see(truth, p, 0, tool[: len(p)], evaluate(truth.deflection, p, None)).point.T for p in parts]
    points = np.concatenate(seen) + 5e-5 * random.standard_normal((count, 3))
    block = Positions(q, nominal.joint_names, points, file="measured.csv", sigma=np.full((count, 3), 5e-5))
    return truth, block


def problem(nominal, count: int):
    """Return the installation to start a fit from, its blocks and the identifiable columns, by 500 of the poses."""
    from calib.data.poses.measurements import take
    from calib.geometry.first_guess import install
    from calib.geometry.fit import fit, polish_frames

    block = measured(nominal, count)[1]
    few = take(block, np.arange(min(500, count)))
    start = polish_frames(install(nominal, [few]), [few]).cell
    return start, block, fit(start, [few]).base


def library(name: str):
    from calib.robot.library import load

    return load(name)


def fit_poses(count: int) -> Callable:
    from calib.geometry.fit import fit

    start, block, _ = problem(library("ur5"), count)
    return lambda: fit(start, [block])


def fit_parameters(count: int) -> Callable:
    from calib.geometry.fit import fit

    start, block, free = problem(arm(PARAMETERS[count]), 1000)
    assert len(free) == count
    return lambda: fit(start, [block])


def scipy_fit(start, block, free, exact: bool) -> Callable:
    """Return SciPy's fit of the same residuals and columns; its Jacobian ours, or by differences."""
    from scipy.optimize import least_squares

    from calib.geometry.observation import observe, predict, prepare, step

    (prepared,) = prepare(start, [block])

    def residual(x):
        return ((block.position.T - predict(step(start, free, x), prepared).point) / block.sigma.T).ravel()

    def slopes(x):
        (part,) = observe(step(start, free, x), prepared, free)
        return -(part.jacobian / block.sigma.T).reshape(len(free), -1).T

    here = np.zeros(len(free))
    if exact:
        return lambda: least_squares(residual, here, slopes, method="lm", x_scale="jac")
    return lambda: least_squares(residual, here, method="lm")


def scipy_jacobian(count: int) -> Callable:
    return scipy_fit(*problem(library("ur5"), count), exact=True)


def scipy_differences(count: int) -> Callable:
    return scipy_fit(*problem(library("ur5"), count), exact=False)


def scipy_parameters(count: int) -> Callable:
    return scipy_fit(*problem(arm(PARAMETERS[count]), 1000), exact=True)


def command_fit(count: int) -> Command:
    nominal = library("ur5")
    block = measured(nominal, count)[1]
    header = ",".join([*(f"{name} [rad]" for name in nominal.joint_names), "x [m]", "y [m]", "z [m]"])
    np.savetxt("measured.csv", np.hstack([block.q, block.position]), "%.9f", ",", header=header, comments="")
    return Command(["fit", "ur5", "measured.csv", "--out", "fit"])


def log(chain, samples: int):
    """Return t, q, v, a and tau of a chain of seven joints at 1 kHz, a minute of random motion over and over."""
    from calib.dynamics.bodies import bodies_of, standard_parameters
    from calib.dynamics.rigid_body import inverse_dynamics
    from calib.simulation.known_robots import random_fourier

    wide = np.full(7, 1.5)
    minute = random_fourier(-wide, wide, wide, 60.0, 1000.0, 60, acceleration=6.0)
    states = [np.resize(x[:-1], (samples, 7)) for x in (minute.q, minute.v, minute.a)]
    once = inverse_dynamics(bodies_of(chain), standard_parameters(chain), minute.q, minute.v, minute.a)
    once += 3.3 * minute.v + 2.5 * np.tanh(minute.v / 0.01) + minute.a + 0.2
    return np.arange(samples) / 1000.0, *states, np.resize(once[:-1], (samples, 7))


def sensed(samples: int) -> dict[str, np.ndarray]:
    t, q, _, _, tau = log(library("lwr4plus"), samples)
    random = np.random.default_rng(0)
    return {
        "t": t, "q": q + 5e-6 * random.standard_normal(q.shape), "tau": tau + 0.3 * random.standard_normal(q.shape)
    }  # fmt: skip


def command_identify(samples: int) -> Command:
    np.savez("log.npz", **sensed(samples))
    return Command(["identify", "lwr4plus", "log.npz", "--out", "dynamics"])


def identify_log(samples: int) -> Callable:
    from calib.data.recordings.recording_files import read_recording
    from calib.data.signals.motion import make_motion
    from calib.identification.identify import identify
    from calib.identification.rows import make_case

    np.savez("log.npz", **sensed(samples))
    chain = library("lwr4plus")
    return lambda: identify(chain, [make_case("log", make_motion(read_recording(Path("log.npz"))))])


def states(chain, count: int) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(3, count, chain.n))


def block_of(chain) -> int:
    """Return the samples of a block."""
    return LANES * max(1, round(BLOCK / (10 * chain.n**2 * LANES)))


def filled(chain, count: int) -> Callable:
    """Return the regressor of `count` samples, block by block into the same memory, as an identification takes it."""
    from calib.dynamics.bodies import bodies_of
    from calib.dynamics.rigid_body import fill_regressor

    given, bodies, block = states(chain, count), bodies_of(chain), block_of(chain)
    out = np.zeros((10 * chain.n, chain.n, block))

    def run():
        for i in range(0, count, block):
            part = given[:, i : i + block]
            fill_regressor(bodies, *part, out[:, :, : part.shape[1]])

    return run


def regressor_samples(count: int) -> Callable:
    return filled(library("lwr4plus"), count)


def regressor_joints(n: int) -> Callable:
    return filled(arm(n), AT_ONCE)


def looped(chain, count: int) -> Callable:
    """Return the same by Pinocchio, sample by sample into the same memory."""
    import pinocchio as pin
    import pinocchio_model

    model, given, block = pinocchio_model.model(chain), states(chain, count), block_of(chain)
    data, out = model.createData(), np.empty((block, chain.n, 10 * chain.n))

    def run():
        for i, state in enumerate(given.transpose(1, 0, 2)):
            out[i % block] = pin.computeJointTorqueRegressor(model, data, *state)

    return run


def pinocchio_samples(count: int) -> Callable:
    return looped(library("lwr4plus"), count)


def pinocchio_joints(n: int) -> Callable:
    return looped(arm(n), AT_ONCE)


def kinematics_joints(n: int) -> Callable:
    from calib.robot.kinematics import jacobian

    chain = arm(n)
    q = states(chain, AT_ONCE)[0]
    return lambda: jacobian(chain, q)


def dynamics_joints(n: int) -> Callable:
    from calib.dynamics.bodies import bodies_of, standard_parameters
    from calib.dynamics.rigid_body import inverse_dynamics

    chain = arm(n)
    given = states(chain, AT_ONCE)
    return lambda: inverse_dynamics(bodies_of(chain), standard_parameters(chain), *given)


def base_joints(n: int) -> Callable:
    from calib.dynamics import base
    from calib.dynamics.bodies import bodies_of
    from calib.dynamics.idim import IdentificationModel

    model = IdentificationModel(bodies_of(arm(n)), ())
    samples = base.random_samples(model, 1000)
    return lambda: base.find(model, samples)


def lapack_joints(n: int) -> Callable:
    """Return LAPACK's triangle of as many rows and columns as 1000 samples of the regressor have."""
    rows = np.random.default_rng(0).normal(size=(1000 * n, 10 * n))
    return lambda: np.linalg.qr(rows, mode="r")


def select_candidates(count: int) -> Callable:
    import library_arm

    from calib.poses.select import select_poses

    jacobians = library_arm.point_jacobian(library_arm.random_poses(count, 0))
    return lambda: select_poses(jacobians, 40)


def command_select(count: int) -> Command:
    words = ["select", "lwr4plus", "-m", "40", "--kind", "position", "--tool", "0.05,0.02,0.11"]
    return Command([*words, "--candidates", str(count), "--out", "poses.csv"])


def least(work: Callable) -> float:
    """Return the least processor time of runs that together take `SHORT` [s]."""
    found: list[float] = []
    while len(found) < 2 or (sum(found) < SHORT and len(found) < 50):
        began = time.process_time()
        work()
        found.append(time.process_time() - began)
        if found[-1] > LONG:
            break
    return min(found)


def measure(work: Callable | Command) -> dict[str, float]:
    """Return what `growth.py` reads."""
    if isinstance(work, Command):
        process = subprocess.Popen([sys.executable, "-m", "calib", *work.words], stdout=subprocess.DEVNULL)
        _, status, used = os.wait4(process.pid, 0)
        if os.waitstatus_to_exitcode(status) not in (0, 1):  # 1: a verdict
            raise SystemExit(f"calib {' '.join(work.words)} ended with {status}")
        return {"cpu": used.ru_utime + used.ru_stime, "memory": used.ru_maxrss / UNIT}
    return {"cpu": least(work), "memory": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / UNIT}


UNIT = 2**20 if sys.platform == "darwin" else 2**10  # of the peak memory, to MB


def made(name: str, size: int) -> Command:
    """Return a command whose input another process has made here: a process counts as its own the peak memory of the
    one that started it, which therefore has to be small."""
    done = subprocess.run([sys.executable, __file__, name, str(size), "--make"], stdout=subprocess.PIPE, check=True)
    return Command(json.loads(done.stdout))


def main(works: dict) -> None:
    name, size = sys.argv[1], int(sys.argv[2])
    if sys.argv[3:] == ["--make"]:
        return print(json.dumps(works[name](size).words))
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        print(json.dumps(measure(made(name, size) if name.startswith("command_") else works[name](size))))
        os.chdir("/")


if __name__ == "__main__":
    main(globals())
