"""The store of a study: what is kept stays, what was half-written goes, nothing counts twice."""

import math
import subprocess
import sys
from pathlib import Path

import pytest
import study_rows
from study_rows import rows

from calib.errors import CalibError, UsageError
from calib.rooms.studies.store import JOURNAL, WHOLE, opened, read_rows


@pytest.fixture
def journal(tmp_path: Path) -> Path:
    """Return the journal of a store of three rows that nobody holds."""
    with opened(tmp_path) as store:
        store.append(rows(3))
    return tmp_path / JOURNAL


def test_rows_come_back_as_they_were(journal: Path):
    found = read_rows(journal.parent)
    assert [row.seed for row in found] == [0, 1, 2]
    assert math.isnan(found[0].beta_error)
    assert (found[0].torque_error, found[0].message) == (0.3, "odd, with a comma 0")


def test_a_key_counts_once(tmp_path: Path):
    with opened(tmp_path) as store:
        store.append(rows(3))
        store.append(rows(4))
        store.settle()
        store.append(rows(5))
    assert len(read_rows(tmp_path)) == 5
    assert len((tmp_path / JOURNAL).read_text().splitlines()) == 2  # header, and the fifth


def test_settled_rows_are_the_same_and_written_the_same(tmp_path: Path):
    with opened(tmp_path) as store:
        store.append(rows(3))
        plain = {row.key: str(row) for row in store.rows.values()}
        store.settle()
        first = (tmp_path / WHOLE).read_bytes()
        store.settle()
        assert (tmp_path / WHOLE).read_bytes() == first
    assert {row.key: str(row) for row in read_rows(tmp_path)} == plain


def test_a_kill_between_settling_and_a_new_journal_counts_nothing_twice(journal: Path):
    before = journal.read_bytes()
    with opened(journal.parent) as store:
        store.settle()
    journal.write_bytes(before)
    assert len(read_rows(journal.parent)) == 3


@pytest.mark.parametrize("cut", [1, 10, 40])
def test_a_half_written_line_is_taken_off_and_told(journal: Path, cut: int):
    journal.write_bytes(journal.read_bytes()[:-cut])
    with opened(journal.parent) as store:
        assert (len(store.rows), store.dropped) == (2, 1)
        store.append(rows(3))
    assert len(read_rows(journal.parent)) == 3


def test_two_commands_do_not_share_a_folder(tmp_path: Path):
    with opened(tmp_path), pytest.raises(UsageError, match="busy: process"), opened(tmp_path):
        pass


@pytest.mark.parametrize(
    ("line", "old", "new", "words"),
    [
        (0, "calib-study-1", "calib-study-0", "another version"),
        (2, ",found,", ",foundd,", "line 3 is damaged .*status 'foundd'.*did you mean 'found'"),
        (2, ",1e-06,", ",", "line 3 is damaged .*cells, not"),
        (1, "tx40", "tx40,7", "line 2 is damaged"),
    ],
)
def test_a_store_of_another_version_or_damaged_is_refused_as_it_is(
    journal: Path, line: int, old: str, new: str, words: str
):
    lines = journal.read_text().splitlines(keepends=True)
    assert old in lines[line]
    spoiled = "".join([*lines[:line], lines[line].replace(old, new), *lines[line + 1 :]])
    journal.write_text(spoiled)
    with pytest.raises(UsageError, match=words), opened(journal.parent):
        pass
    assert journal.read_text() == spoiled


@pytest.mark.slow
def test_a_full_disk_loses_nothing_that_was_kept(tmp_path: Path):
    """Under a limit of the file's size a row is refused whole, and the rows before it stand."""
    script = f"""
import resource, sys
sys.path.insert(0, {str(Path(study_rows.__file__).parent)!r})
from pathlib import Path
from calib.errors import CalibError
from calib.rooms.studies.store import JOURNAL, opened
from study_rows import rows
with opened(Path({str(tmp_path)!r})) as store:
    store.append(rows(3))
    size = (store.folder / JOURNAL).stat().st_size + 40  # a third of a row
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
    try:
        store.append([rows(5)[4]])
    except CalibError as error:
        print(error)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert "3 rows are kept" in done.stdout
    assert len(read_rows(tmp_path)) == 3
    with opened(tmp_path) as store:
        assert store.dropped == 0


def test_a_folder_that_cannot_be_made_is_refused(tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises(CalibError), opened(tmp_path / "file" / "inside"):
        pass
