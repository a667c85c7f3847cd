"""Internal errors: one message, a code of their own, and a file for whoever mends them."""

import tomllib
from pathlib import Path

import pytest

from calib import bug_reports, cli
from calib.errors import complaint

ROOT = Path(__file__).parents[1]


def failing(error: BaseException):
    def describe(topic: str) -> str:
        raise error

    return describe


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("CALIB_DEBUG", raising=False)


@pytest.mark.parametrize(
    "error, code, words",
    [
        (KeyError("axis"), 4, "internal error: KeyError: 'axis'; a bug report was written: calib-bug-"),
        (PermissionError(13, "Permission denied", "/x/y.csv"), 2, "/x/y.csv: Permission denied"),
        (OSError(28, "No space left on device"), 2, "No space left"),
        (MemoryError("Unable to allocate 373. GiB"), 2, "Unable to allocate 373. GiB; of a long recording use fewer"),
        (MemoryError(), 2, "calib: not enough memory; of a long recording use fewer samples ([recording] samples = "),
        (OSError(12, "Cannot allocate memory"), 2, "not enough memory: [Errno 12] Cannot allocate memory; of"),
        (BrokenPipeError(32, "Broken pipe"), 141, ""),
    ],
)
def test_any_failure_is_one_line_and_a_code(error, code, words, monkeypatch, capsys, tmp_path) -> None:
    """Whatever happens, the command ends with one line and a code."""
    monkeypatch.setattr("calib.procedure.formats.describe", failing(error))
    assert cli.run(["formats", "mdh"]) == code
    said = capsys.readouterr().err
    assert words in said and said.count("\n") <= 1 and "Traceback" not in said
    reports = list(tmp_path.glob("calib-bug-*.txt"))
    assert len(reports) == (code == 4)
    if reports:
        text = reports[0].read_text()
        assert text.startswith(f"calib formats mdh\nfor {bug_reports.TRACKER}\nPython ")
        assert "in describe" in text and "numpy " in text


def test_lack_of_memory_names_largest_file(tmp_path) -> None:
    """Lack of memory behind a library that cannot be loaded names the largest file."""
    (tmp_path / "log.npz").write_bytes(b"x" * 900)
    (tmp_path / "arm.urdf").write_bytes(b"x" * 90)
    try:
        try:
            raise OSError("libllvmlite.so: failed to map segment from shared object")
        except OSError as error:
            raise OSError("Could not find/load shared object file 'libllvmlite.so'") from error
    except OSError as error:
        words, code = complaint(error, ["identify", "arm.urdf", "log.npz@0:9.4", "--out", "x"])  # type: ignore[misc]
    assert code == 2 and words.startswith("log.npz: not enough memory: libllvmlite.so: failed to map segment")


def test_one_tracker_is_named_everywhere() -> None:
    """Reports, README and project name one tracker."""
    urls = tomllib.loads((ROOT / "pyproject.toml").read_text()).get("project", {}).get("urls", {})
    assert urls.get("Issues", bug_reports.TRACKER) == bug_reports.TRACKER
    assert bug_reports.TRACKER in " ".join((ROOT / "README.md").read_text().replace("`", "").split())
    assert bug_reports.TRACKER in bug_reports.report(ValueError("x"), ["fit"])


def test_report_avoids_unwritable_folder(monkeypatch, capsys, tmp_path) -> None:
    """A report goes elsewhere where the folder cannot be written."""
    other = tmp_path / "other"
    other.mkdir()
    gone = tmp_path / "gone"
    gone.write_text("a file, not a folder")
    monkeypatch.setattr("tempfile.tempdir", str(other))
    words = bug_reports.report(ValueError("x"), ["fit"], gone)
    assert str(other) in words and len(list(other.iterdir())) == 1


def test_debug_shows_the_traceback(monkeypatch) -> None:
    monkeypatch.setenv("CALIB_DEBUG", "1")
    monkeypatch.setattr("calib.procedure.formats.describe", failing(KeyError("axis")))
    with pytest.raises(KeyError):
        cli.run(["formats", "mdh"])


@pytest.mark.parametrize("word", ["", "m\udcff.csv"])
def test_empty_or_non_utf8_word_is_refused(word, capsys) -> None:
    """A word that is empty or no UTF-8 is refused."""
    assert cli.run(["formats", word]) == 2 and "formats" in capsys.readouterr().err


def test_foreign_warnings_are_held_back() -> None:
    """Warnings of others are held back, and ours pass."""
    import warnings

    from calib.errors import CalibWarning, quiet

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with quiet():
            warnings.warn("theirs", RuntimeWarning, stacklevel=1)
            warnings.warn("ours", CalibWarning, stacklevel=1)
    assert [str(one.message) for one in caught] == ["ours"]
