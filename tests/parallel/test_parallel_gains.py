"""Drive gains of parallel robots by a payload of known mass, from currents."""

import numpy as np
import pytest
from platform_sines import recorded

from calib.errors import UsageError
from calib.identification.identify_options import parse_options
from calib.parallel.robots import find
from calib.procedure.dynamic_stage.inputs import gather


def found(name: str, noise: float, seed: int, changes: dict | None = None, samples: int = 1000):
    """Return true gains, and those from two runs without and two with a payload of 5.37 kg."""
    robot = find(name)
    gains = np.linspace(1.5, 2.5, robot.chain.n)
    own = {"samples": samples, "preload": 10.0 * robot.chain.redundant, "noise": noise, "gains": gains}
    runs = [recorded(robot.mechanism, load, seed=10 * seed + k, **own) for k, load in enumerate(((), ("5",)) * 2)]
    empty, loaded = ([run.file for run in part] for part in (runs[::2], runs[1::2]))
    table = {
        "payload": {"5": {"mass": 5.37}}, "files": {file: {"payload": ["5"]} for file in loaded}, "v0": 0.05,
        "gain_identification": {"unloaded": empty, "loaded": loaded},
    }  # fmt: skip
    table |= changes or {}
    return gains, gather(robot, runs, options=parse_options({k: v for k, v in table.items() if v is not None})).gains


@pytest.mark.parametrize(
    "name", [pytest.param("dualv", marks=pytest.mark.slow), pytest.param("stewart", marks=pytest.mark.slow)]
)
def test_known_payload_gives_gains(name):
    """Redundant actuators with a preload that nobody states, currents with noise of different size."""
    gains, identified = found(name, 0.2 if name == "dualv" else 5.0, 0)
    assert np.abs(identified.gains / gains - 1.0).max() < 0.02
    assert (np.abs(identified.gains - gains) < 3.0 * identified.sigma).all()
    assert (identified.sigma < 0.02 * gains).all()
    np.testing.assert_allclose(identified.std[1:] * gains[1:], identified.std[0] * gains[0], rtol=0.15)


@pytest.mark.slow
def test_gain_sigmas_hold_under_noise():
    """Six trials with 3 N m of noise on some 20 N m, where least squares draws the gains to zero."""
    trials = [found("dualv", 3.0, seed, samples=4000) for seed in range(6)]
    away = np.array([(own.gains - gains) / own.sigma for gains, own in trials])
    assert 0.5 < np.sqrt(np.mean(away**2)) < 1.5


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        pytest.param({"gain_identification": None}, "currents without gains", marks=pytest.mark.slow),
        ({"payload": {"5": {}}}, "with its mass"),
        pytest.param(
            {"payload": {"5": {"mass": 5.37}, "6": {"mass": 1.0}}}, "was the payload attached", marks=pytest.mark.slow
        ),
    ],
)
def test_gains_need_a_known_payload(changes, said):
    """Gains without a known payload are refused."""
    with pytest.raises(UsageError, match=said):
        found("dualv", 0.5, 0, changes, samples=500)
