"""A minute of log to a validated Model 2, beside merely parsing that log from CSV with pandas.

pip install --target /tmp/pandas --no-deps pandas python-dateutil six
PYTHONPATH=.:/tmp/pandas python -m pytest tests/benchmarks/test_minute_of_log.py -o addopts= \
    --benchmark-timer=time.process_time --benchmark-columns=min,median,rounds
"""

from pathlib import Path

import numpy as np
import pytest

from calib.data.recordings.recording_files import read_recording
from calib.data.signals.motion import make_motion
from calib.dynamics.bodies import bodies_of, standard_parameters
from calib.dynamics.rigid_body import inverse_dynamics
from calib.dynamics.torque_rows import BOTH
from calib.identification.identify import identify
from calib.identification.prediction import predict, score
from calib.identification.rows import make_case
from calib.identification.settings import IdentificationSettings
from calib.robot.library import load
from calib.simulation.known_robots import random_fourier

CHAIN = load("lwr4plus")
N, RATE, SECONDS = 7, 1000.0, 60.0
MODEL_2 = IdentificationSettings(torque_rows=BOTH, sets=("Ia Fvm Fcm offm Fvl Fcl",), friction="standard", prior="none")


def write(folder: Path, seed: int) -> tuple[Path, Path]:
    """Write a minute of q, tau and tau_link as npz and CSV."""
    reach, speed = np.full(N, 1.5), np.full(N, 1.5)
    motion = random_fourier(-reach, reach, speed, SECONDS, RATE, 60, acceleration=6.0, seed=seed)
    q, v, a = motion.q, motion.v, motion.a
    random = np.random.default_rng(seed)
    link = inverse_dynamics(bodies_of(CHAIN), standard_parameters(CHAIN), q, v, a) + 0.3 * v + 0.5 * np.tanh(v / 0.01)
    motor = link + a + 3.0 * v + 2.0 * np.tanh(v / 0.01) + 0.2
    parts = {
        "t": np.arange(len(q)) / RATE,
        "q": np.round(q + random.normal(scale=5e-6, size=q.shape), 8),
        "tau": np.round(motor + random.normal(scale=0.3, size=q.shape), 5),
        "tau_link": np.round(link + random.normal(scale=0.1, size=q.shape), 5),
    }
    np.savez(folder / f"{seed}.npz", **parts)
    header = ["t", *(f"{name}_{j + 1}" for name in ("q", "tau", "tau_link") for j in range(N))]
    table = np.column_stack(list(parts.values()))
    np.savetxt(folder / f"{seed}.csv", table, delimiter=",", header=",".join(header), comments="", fmt="%.9g")
    return folder / f"{seed}.npz", folder / f"{seed}.csv"


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("minutes")
    return write(folder, 1), write(folder, 2)


def identified(train: Path, other: Path):
    cases = [make_case(path.name, make_motion(read_recording(path)), BOTH) for path in (train, other)]
    found = identify(CHAIN, cases[:1], MODEL_2)
    return found, [score(case, predict(found.dynamics, case)) for case in cases]


@pytest.mark.benchmark(group="60 s of 1 kHz, 7 joints, Model 2: two logs to estimate, covariance and validation")
@pytest.mark.parametrize("what", ["from npz", "from CSV", "reading one CSV", "pandas parses one CSV"])
def test_a_minute_of_log(benchmark, logs, what):
    (train, train_csv), (other, other_csv) = logs
    if what == "pandas parses one CSV":
        pandas = pytest.importorskip("pandas", reason="pandas is not installed: see the module's first lines")
        table = benchmark.pedantic(pandas.read_csv, (train_csv,), rounds=10, warmup_rounds=1)
        assert table.shape == (SECONDS * RATE + 1, 22)
    elif what == "reading one CSV":
        recording = benchmark.pedantic(read_recording, (train_csv,), rounds=10, warmup_rounds=1)
        assert recording.q.shape == (SECONDS * RATE + 1, N)
    else:
        paths = (train, other) if what == "from npz" else (train_csv, other_csv)
        found, scores = benchmark.pedantic(identified, paths, rounds=5, warmup_rounds=1)
        assert len(found.fitted.estimate.values) == len(found.names) and scores[1].filtered.total < 1.0
