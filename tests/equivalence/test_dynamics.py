"""`calib identify` and a session's steps identify and predict give one answer to the same recordings."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import planted_motion as planted
import pytest
from both_ways import Judgement, agree, command, read, refusal
from sessions import quiet

from calib.procedure.report import dynamics_section
from calib.procedure.session import dynamics_steps, geometry_steps
from calib.procedure.session.folder import Session, open_session

Series = dict[str, np.ndarray]
DYNAMICS = {
    "wanted": "true", "plan": "false", "validation": "false", "friction": '"standard"', "period": "4.0",
    "harmonics": "2", "rate": "100.0", "repeats": "1", "starts": "1", "evaluations": "20",
}  # fmt: skip
MODEL = (
    "parameters", "condition_number", "friction", "method", "ladder", "elimination", "geometry", "findings", "unit",
)  # fmt: skip


@pytest.fixture(scope="module")
def with_dynamics(fitted: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session whose geometry is calibrated; its dynamics are identified in copies of it."""
    place = tmp_path_factory.mktemp("dynamics") / "cell"
    shutil.copytree(fitted, place)
    settings = place / "session.toml"
    head, dynamics = settings.read_text().split("[dynamics]", 1)
    for key, value in DYNAMICS.items():
        dynamics = re.sub(rf"(?m)^{key} = .*$", f"{key} = {value}", dynamics, count=1)
    settings.write_text(f"{head}[dynamics]{dynamics}")
    (place / "7-recorded").mkdir()
    return place


@pytest.fixture
def session(with_dynamics: Path, tmp_path: Path) -> Session:
    shutil.copytree(with_dynamics, tmp_path / "cell")
    return open_session(tmp_path / "cell", plots=False)


def clean(training: Series, unseen: Series) -> None:
    """Change nothing."""


def reversed_torque(training: Series, unseen: Series) -> None:
    """Turn the sign of the joint about the vertical, which no check of the nominal masses can see."""
    for series in (training, unseen):
        series["tau"][:, 0] *= -1.0


def swapped_columns(training: Series, unseen: Series) -> None:
    for series in (training, unseen):
        series["tau"] = series["tau"][:, [0, 2, 1]]


def another_joint_order(training: Series, unseen: Series) -> None:
    for series in (training, unseen):
        series["q"] = series["q"][:, [1, 0, 2]]


def copied(training: Series, unseen: Series) -> None:
    unseen.update(training)


def standing(training: Series, unseen: Series) -> None:
    unseen["q"] = np.repeat(unseen["q"][:1], len(unseen["q"]), axis=0)


def timeless(tracking: dict[str, Any]) -> dict[str, Any]:
    """Return what tracking came to, without how long its simulation took."""
    return {
        name: {key: value for key, value in one.items() if key != "seconds"} if isinstance(one, dict) else one
        for name, one in tracking.items()
    }


def by_command(session: Session, out: Path) -> Judgement:
    place = session.path("7-recorded")
    refused = command(
        "identify", session.path("4-fit"), place / "training.npz", "--validate", place / "validation.npz", "--friction",
        "standard", "--out", out,
    )  # fmt: skip
    if refused:
        return Judgement(refused=refused)
    found = read(out / "metrics.json")
    numbers = {"fit": found["identification"], **{key: found[key] for key in ("validation", *MODEL)}}
    numbers["tracking"] = timeless(found["tracking"])
    return Judgement(found["verdict"], found["reason"], numbers, frozenset(found["warnings"]))


def by_session(session: Session) -> Judgement:
    refused = refusal(lambda: dynamics_steps.record(session, quiet))
    refused = refused or refusal(lambda: dynamics_steps.identify(session, quiet))
    if refused:
        return Judgement(refused=refused)
    notes = [str(note) for note in dynamics_steps.predict(session, quiet)]
    found = read(session.path("8-dynamics/unseen/report.json"))
    own, printed = read(session.path("8-dynamics/metrics.json")), dynamics_section.read(session.path("8-dynamics"))
    assert set(found["warnings"]) <= {*notes, *own["warnings"]}  # said by one of the two steps
    numbers = {key: found[key] for key in ("fit", "validation")} | {key: own[key] for key in MODEL}
    numbers["tracking"] = timeless(found["tracking"])
    section = dynamics_section.report_section(printed, {})
    assert (section.verdict, section.reason) == (found["verdict"], found["reason"])
    # the session delivers the exported robot: its figure stands before the sentence on the identified model
    _, stated, identified = found["reason"].partition("(identified model: ")
    reason = identified.removesuffix(")") if stated else found["reason"]
    return Judgement(found["verdict"], reason, numbers, frozenset(found["warnings"]))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "verdict"),
    [
        (clean, "pass"),
        (reversed_torque, "fail"),
        (swapped_columns, "fail"),
        pytest.param(another_joint_order, "fail", marks=pytest.mark.slow),
        pytest.param(copied, "marginal", marks=pytest.mark.slow),
        pytest.param(standing, "marginal", marks=pytest.mark.slow),
    ],
)
def test_command_and_session_agree(
    session: Session, tmp_path: Path, change: Callable[[Series, Series], None], verdict: str
) -> None:
    training, unseen = (planted.series(seed, noise=0.02, duration=10.0) for seed in (0, 7))
    change(training, unseen)
    for name, series in (("training", training), ("validation", unseen)):
        np.savez(session.path(f"7-recorded/{name}.npz"), allow_pickle=False, **series)
    two = by_session(session)
    agree(by_command(session, tmp_path / "model"), two)
    assert two.verdict == verdict
    if change is clean:
        the_same_robot_is_exported(session, tmp_path / "export")


def the_same_robot_is_exported(session: Session, out: Path) -> None:
    geometry_steps.export(session, quiet)
    assert not command("export", session.path("8-dynamics"), "--into", out)
    for path in out.iterdir():
        if path.name == "README.txt":  # a session's says what was judged of the geometry, too
            continue
        assert path.read_bytes() == (session.path(session.export) / path.name).read_bytes(), path.name


@pytest.mark.slow
def test_the_same_motion_is_designed(session: Session, tmp_path: Path) -> None:
    settings = session.path("session.toml")
    head, dynamics = settings.read_text().split("[dynamics]", 1)
    settings.write_text(f"{head}[dynamics]{dynamics.replace('plan = false', 'plan = true', 1)}")
    session = open_session(settings.parent, plots=False)
    dynamics_steps.excite(session, quiet)
    words = "--period 4 --harmonics 2 --rate 100 --starts 1 --evaluations 20 --repeat 1"
    (tmp_path / "options.toml").write_text(f'rows = "{session.settings.dynamics.torques}"\nfriction = "standard"\n')
    chosen = (*words.split(), "--options", tmp_path / "options.toml", "--out", tmp_path / "motion")
    assert not command("excite", session.path("4-fit"), *chosen)
    names = {path.name for path in (tmp_path / "motion").iterdir()}
    assert names == {path.name for path in session.path("6-excitation/training").iterdir()}
    for name in names - {"metrics.json"}:
        own = session.path("6-excitation/training") / name
        assert own.read_bytes() == (tmp_path / "motion" / name).read_bytes(), name
