"""Payloads of a session: stated in answers and settings, carried by recordings, judged, rehearsed."""

import json
import shutil
from pathlib import Path

import pytest
from sessions import begin
from without_figures import run

from calib.apps.cell_demo.demo import MOTION
from calib.errors import CalibError, UsageError
from calib.identification.settings import Payload
from calib.procedure.session.commands import _present_logs
from calib.procedure.session.dynamics_steps import options_of, unrecorded_payloads
from calib.procedure.session.folder import open_session
from calib.procedure.session.questions import stated_payloads
from calib.procedure.session.settings import read_settings, written


@pytest.fixture
def short_motions(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the demonstration design shorter motions by a shorter search."""
    monkeypatch.setitem(MOTION, "period", 6.0)
    monkeypatch.setitem(MOTION, "evaluations", 40)


@pytest.mark.parametrize(
    ("text", "payload"),
    [
        ("load=3.28", {"mass": 3.28}),
        ("load = 3.28kg", {"mass": 3.28}),
        ("load=3.28 at 0,0.01,0.05", {"mass": 3.28, "com": [0.0, 0.01, 0.05]}),
        ("load", {}),
    ],
)
def test_mass_and_centre_are_read(text: str, payload: dict[str, object]) -> None:
    assert stated_payloads([text]) == {"load": payload}


@pytest.mark.parametrize("text", ["3.28", "load=", "load=-1", "load=nan", "load=1 at 0,0", "load=1 at 9,0,0", "a b=1"])
def test_invalid_payload_shows_its_form(text: str) -> None:
    with pytest.raises(UsageError, match=r"--payload .*; expected label=kg"):
        stated_payloads([text])


def test_label_stated_twice_is_refused() -> None:
    with pytest.raises(UsageError, match="'load' is stated twice"):
        stated_payloads(["load=1", "load=2"])


def test_labels_that_differ_by_case_are_refused() -> None:
    """Names of files do not tell upper from lower case."""
    with pytest.raises(UsageError, match="'Load' and 'load' differ by upper and lower case alone"):
        stated_payloads(["Load=1", "load=2"])


def test_label_in_every_name_is_refused(tmp_path: Path) -> None:
    """A label that is a word of all recordings' names would be carried by all of them."""
    with pytest.raises(CalibError, match="'log' is a part of all recordings' names"):
        begin(tmp_path / "cell", "tx40", "cmm", 5, 0, payloads={"log": 1.0})


def test_payloads_survive_the_settings_file(tmp_path: Path) -> None:
    payloads = {"load": {"mass": 3.28, "com": [0.0, 0.01, 0.05]}, "tool": 2.0, "box": {}}
    session = begin(tmp_path / "cell", "tx40", "cmm", 5, 0, payloads=payloads)
    settings = read_settings(session.path("session.toml"))
    expected = {"load": Payload(3.28, (0.0, 0.01, 0.05)), "tool": Payload(2.0), "box": Payload()}
    assert dict(settings.dynamics.payloads) == expected
    session.path("session.toml").write_text(written(settings))
    assert read_settings(session.path("session.toml")) == settings


def test_labels_are_words_of_names(tmp_path: Path) -> None:
    """A label counts as a word of a file's name, with digits behind it; of two labels the longer one counts."""
    payloads = {"Load": 1.0, "load2": 2.0, "a": 3.0, "big_load": 4.0}
    session = begin(tmp_path / "cell", "tx40", "cmm", 5, 0, payloads=payloads)
    labels = {
        "training_log.csv": (),
        "training_LOAD_log.csv": ("Load",),
        "training_load2_log.csv": ("load2",),
        "training_load3_log.csv": ("Load",),
        "training_load20_log.csv": ("Load",),
        "training_loaded_log.csv": ("Load",),
        "training_big_load_log.csv": ("big_load",),
        "validation_unload_log.csv": (),
        "training_a_load_log.csv": ("Load", "a"),
    }
    for name in labels:
        session.path(f"7-recorded/{name}").write_text("t\n")
    options = options_of(session)
    for name, carried in labels.items():
        assert options.file_settings(f"7-recorded/{name}").payload == carried, name
    assert unrecorded_payloads(session) == []
    session.path("7-recorded/training_load2_log.csv").unlink()
    assert unrecorded_payloads(session) == ["load2"]


def test_misspelt_log_is_named_while_waiting(tmp_path: Path) -> None:
    """While a session waits for a log, the logs that are there stand with what their names make of them."""
    session = begin(tmp_path / "cell", "tx40", "cmm", 5, 0, payloads={"load": 2.0})
    for name in ("training_lod_log.csv", "validation_load_log.csv"):
        session.path(f"7-recorded/{name}").write_text("t\n")
    words = _present_logs(session)
    assert "training_lod_log.csv (training without payload)" in words
    assert "validation_load_log.csv (validation with load)" in words


@pytest.mark.slow
@pytest.mark.usefixtures("short_motions")
def test_loaded_logs_are_taken_and_judged(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """A rehearsal with a payload waits for loaded logs, judges them, and fails where logs are exchanged."""
    cell = tmp_path / "cell"
    assert run("demo", "--out", cell, "--guided", "--payload", "load=2.5 at 0.01,0.02,0.08") == 0
    for _ in range(2):
        assert run("demo", "--bring", cell) == 0
        if not (cell / "7-recorded/training_log.csv").exists():
            assert run("next", cell) == 0
    log = cell / "7-recorded/training_load_log.csv"
    shutil.move(log, tmp_path / "loaded.csv")
    capsys.readouterr()
    assert run("next", cell) == 0
    words = " ".join(capsys.readouterr().out.split())
    assert "with 'load' (2.5 kg at 0.01,0.02,0.08) on the flange" in words and "training_load_log.csv" in words

    exchanged = tmp_path / "exchanged"
    shutil.copytree(cell, exchanged)
    shutil.copy(exchanged / "7-recorded/training_log.csv", exchanged / "7-recorded/training_load_log.csv")
    shutil.copy(tmp_path / "loaded.csv", exchanged / "7-recorded/training_log.csv")
    assert run("next", exchanged) == 1

    shutil.move(tmp_path / "loaded.csv", log)
    assert run("next", cell) == 0
    judged = open_session(cell).identification.unseen.read().proofs
    assert {"validation_log.csv", "validation_load_log.csv"} == set(judged)
    assert run("demo", "--bring", cell) == 0
    assert json.loads((cell / "truth.json").read_text())["torque_percent"] < 5.0
    assert "load 2.5 kg at 0.01,0.02,0.08" in (cell / "certificate.html").read_text()


@pytest.mark.slow
@pytest.mark.usefixtures("short_motions")
def test_mass_is_identified_from_its_runs(tmp_path: Path) -> None:
    """Without a stated mass or centre it is identified, and exchanged recordings are named as such."""
    cell = tmp_path / "cell"
    assert run("demo", "--out", cell, "--payload", "load") == 0
    rows = (cell / "8-dynamics/estimate.csv").read_text().splitlines()
    (mass,) = [float(row.split(",")[3]) for row in rows if row.startswith("Mload,")]
    assert mass == pytest.approx(2.0, abs=0.05)
    training, loaded = cell / "7-recorded/training_log.csv", cell / "7-recorded/training_load_log.csv"
    texts = training.read_bytes(), loaded.read_bytes()
    loaded.write_bytes(texts[0])
    training.write_bytes(texts[1])
    assert run("next", cell) == 1
    metrics = json.loads((cell / "8-dynamics/metrics.json").read_text())
    assert "payload-exchanged" in {notice["code"] for notice in metrics["noticed"]}
