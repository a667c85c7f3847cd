"""The store of a study: what is kept stays, what was half-written goes, nothing counts twice."""

import math
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest
import study_rows
from study_rows import rows

from calib.apps.studies.store import ROWS, opened, read_rows
from calib.errors import CalibError, UsageError


@pytest.fixture
def kept(tmp_path: Path) -> Path:
    """Return the file of a store of three rows that nobody holds."""
    with opened(tmp_path) as store:
        store.append(rows(3))
    return tmp_path / ROWS


def test_rows_come_back_as_they_were(kept: Path):
    found = read_rows(kept.parent)
    assert [row.seed for row in found] == [0, 1, 2]
    assert math.isnan(found[0].beta_error)
    assert (found[0].torque_error, found[0].message) == (0.3, "odd, with a comma 0")


def test_a_key_counts_once(tmp_path: Path):
    for count in (3, 4, 5):
        with opened(tmp_path) as store:
            store.append(rows(count))
    assert len(read_rows(tmp_path)) == 5


def test_rows_are_read_during_writes(tmp_path: Path):
    """Rows are read while a command writes."""
    with opened(tmp_path) as store:
        store.append(rows(2))
        assert len(read_rows(tmp_path)) == 2
        store.append(rows(3))
        assert len(read_rows(tmp_path)) == 3


@pytest.mark.slow
def test_kill_during_write_loses_no_row(tmp_path: Path):
    """The process dies with a transaction open: the next command finds the rows that were kept, and goes on."""
    script = f"""
import os, sys
sys.path.insert(0, {str(Path(study_rows.__file__).parent)!r})
from pathlib import Path
from calib.apps.studies.store import _INSERT, _cells, opened
from study_rows import rows
with opened(Path({str(tmp_path)!r})) as store:
    store.append(rows(2))
    store._database.execute("BEGIN")
    store._database.execute(_INSERT, _cells(rows(3)[2]))
    os._exit(9)
"""
    assert subprocess.run([sys.executable, "-c", script]).returncode == 9
    with opened(tmp_path) as store:
        assert len(store.rows) == 2
        store.append(rows(3))
    assert len(read_rows(tmp_path)) == 3


def test_two_commands_do_not_share_a_folder(tmp_path: Path):
    with opened(tmp_path), pytest.raises(UsageError, match="busy: process"), opened(tmp_path):
        pass


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        ("PRAGMA user_version = 1", "another version"),
        ("UPDATE rows SET status = 'foundd' WHERE seed = 1", "no trial ends with the status 'foundd'"),
        ("DROP TABLE rows; CREATE TABLE rows (digest)", "damaged: no such column"),
    ],
)
def test_other_or_damaged_store_is_refused(kept: Path, spoil: str, words: str):
    """A store of another version, or a damaged one, is refused as it is."""
    with closing(sqlite3.connect(kept)) as base:
        base.executescript(spoil)
    before = kept.read_bytes()
    with pytest.raises(UsageError, match=words), opened(kept.parent):
        pass
    assert kept.read_bytes() == before


def test_what_is_no_store_is_refused(kept: Path):
    kept.write_text("a,b\n1,2\n")
    with pytest.raises(UsageError, match="damaged"):
        read_rows(kept.parent)


@pytest.mark.slow
def test_full_disk_loses_nothing_kept(tmp_path: Path):
    """Under a limit of the file's size a row is refused whole, and the rows before it stand."""
    script = f"""
import resource, sys
sys.path.insert(0, {str(Path(study_rows.__file__).parent)!r})
from pathlib import Path
from calib.errors import CalibError
from calib.apps.studies.store import ROWS, opened
from study_rows import rows
with opened(Path({str(tmp_path)!r})) as store:
    store.append(rows(3))
    size = (store.folder / ROWS).stat().st_size  # not a byte more
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
    try:
        store.append(rows(500)[4:])
    except CalibError as error:
        print(error)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert "3 rows are kept" in done.stdout
    assert len(read_rows(tmp_path)) == 3


def test_impossible_folder_is_refused(tmp_path: Path):
    """A folder that cannot be made is refused."""
    (tmp_path / "file").write_text("")
    with pytest.raises(CalibError), opened(tmp_path / "file" / "inside"):
        pass


@pytest.mark.parametrize("name", ["rows.csv", "rows.parquet"])
def test_rows_of_format_1_are_refused(tmp_path: Path, name: str):
    (tmp_path / name).write_text("calib-study-1,condition,digest\n")
    for attempt in (read_rows, lambda folder: opened(folder).__enter__()):
        with pytest.raises(UsageError, match=f"{name} is of another version of this toolkit .format 1, here 2."):
            attempt(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [name]
