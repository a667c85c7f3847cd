"""The DualV study and the power model of the TX40 run, and show what they claim to."""

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from scripts import run_here

from calib.trajectories.design.problem import ExcitationProblem, exact_values, merit
from calib.trajectories.design.verify import verify_motion

EXAMPLES = Path(__file__).parents[2] / "examples"
# relative, beside the last digit printed: what another processor's rounding may change in the same motions' numbers
ROUNDING = 0.01
# of the mean log eigenvalue, between short searches and whole ones: 0.4 to 1.3; random motions are 2.8 to 5 away
NEAR = 2.0


@pytest.fixture(scope="module")
def study() -> ModuleType:
    return _loaded("dualv_study", EXAMPLES / "dualv" / "study.py")


@pytest.mark.slow
def test_dualv_is_identified_and_weighed(study, tmp_path, capsys):
    """Sixteen inertial base parameters, the payload to 1 %, IDIM tighter than PIM, equal legs tighter than unequal
    ones, other motion predicted better than the paper's 0.099, 0.084, 0.149: in the first of the README's
    five trials, on stored motions."""
    run_here(EXAMPLES / "dualv/study.py", "--seeds=3", "--trials=1", f"--out={tmp_path}", capsys=capsys)
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["inertial_base_parameters"] == 16
    for run in metrics["runs"]:
        assert all(abs(one["values"]["M5"] / 5.37 - 1.0) < 0.01 for one in run["methods"].values())
        sigma = {name: one["sigma_percent"] for name, one in run["methods"].items()}
        assert all(sigma["idim"][name] < sigma["pim"][name] for name in (*study.LEGS, "ZZ4"))
        assert sigma["pim_equal_legs"]["ZZ11"] < min(sigma["pim"][name] for name in study.LEGS)
        assert all(ours < theirs for ours, theirs in zip(run["cross_validation"]["idim"], study.CROSS))
    _check_readme(study, metrics)
    assert all((tmp_path / name).exists() for name in ("forces.png", "torques.png", "overconstraint.png", "power.png"))


def _check_readme(study: ModuleType, metrics: dict) -> None:
    """A fresh trial's numbers are within the ranges of the README's tables."""
    text = (EXAMPLES / "dualv" / "README.md").read_text()
    kept = text.split(study.MARKS[0])[1].split(study.MARKS[1])[0].strip().splitlines()
    fresh = "\n".join(study.readme_rows(metrics)).strip().splitlines()
    assert len(kept) == len(fresh)
    for old, new in zip(kept, fresh):
        for one, two in zip(old.split("|"), new.split("|"), strict=True):
            if " to " in one:
                value = float(two.split()[0])
                words = [word.strip(" ()") for word in one.split("(")[1].split(" to ")]
                least, most = (float(word) for word in words)
                spare = 10.0 ** -max(len(word.partition(".")[2]) for word in words)
                assert least - ROUNDING * abs(least) - spare <= value <= most + ROUNDING * abs(most) + spare, (old, new)
            else:
                assert one == two


def _worth(problem: ExcitationProblem, x: np.ndarray) -> float:
    """Return the merit of a motion at the samples of a search; the smaller, the better."""
    motion = problem.basis().motion(x)
    return merit(problem, exact_values(problem, motion, problem.regressor(motion.q, motion.v, motion.a)))


@pytest.mark.slow
def test_stored_motions_are_those_of_the_search(study):
    """Every stored motion keeps all limits, between the samples, too, and is worth what its search told.

    The searches ended by themselves, and a short one comes near to them.
    """
    short = study.designed(0, evaluations=study.MOST // 25)
    problem = short.problem
    reached = []
    for seed in range(study.SEEDS):
        motion = study.Motion.read(seed)
        x = problem.family.variables(motion.series.coefficients)
        assert np.allclose(np.array(problem.family.coefficients(x)), motion.series.coefficients, rtol=0, atol=1e-9)
        assert verify_motion(problem.family, x, problem.constraints).feasible
        assert _worth(problem, x) == pytest.approx(motion.reached["merit"], abs=1e-6)
        assert motion.reached["evaluations"] < study.MOST
        reached.append(motion.reached["merit"])
    assert _worth(problem, short.found.x) < max(reached) + NEAR


@pytest.mark.slow
def test_decoupled_motion_shows_wrist_drives():
    """In the power of a decoupled motion the wrist's drives are better determined."""
    found = _loaded("tx40_power", EXAMPLES / "tx40" / "power.py").main()
    together, apart = found["power, all joints"], found["power, wrist apart"]
    assert apart["drives 4-6"] < 0.7 * together["drives 4-6"] and apart["bodies 4-6"] < together["bodies 4-6"]


def _loaded(name: str, path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module
