"""JSON becomes what a dataclass says, or the message names the place."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pytest

from calib import files
from calib.errors import CalibError
from calib.records import Array, Number, plain, read_json, read_record, stored


class Pair(NamedTuple):
    name: str
    share: float | None


@dataclass(frozen=True)
class Inner:
    values: tuple[float, ...]
    pair: Pair | None = None


@dataclass(frozen=True)
class Outer:
    name: str
    inner: Inner
    each: Mapping[str, Inner]
    both: tuple[int, int] = (0, 0)


GOOD = {"name": "a", "inner": {"values": [1, 2.5], "pair": ["x", None], "newer": 7}, "each": {"b": {"values": []}}}


def test_nested_content_becomes_values():
    found = read_record(Outer, GOOD | {"both": [np.int64(1), 2]})
    assert found == Outer("a", Inner((1.0, 2.5), Pair("x", None)), {"b": Inner(())}, (1, 2))
    assert read_record(tuple[Pair, ...], [["x", 1]]) == (Pair("x", 1.0),)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"name": 3}, "^name: .*found 3"),
        ({"inner": {}}, "^inner.values: "),
        ({"inner": {"values": [1, "b"]}}, r"^inner.values\[1\]: .*found 'b'"),
        ({"each": {"b": {"values": [True]}}}, r"^each.b.values\[0\]: .*found True"),
        ({"inner": {"values": [], "pair": ["x"]}}, r"^inner.pair"),
        ({"both": [1, 2.5]}, r"^both\[1\]: .*found 2.5"),
    ],
)
def test_misplaced_record_entry_is_located(change, words):
    """What does not belong into a record is named with its place."""
    with pytest.raises(ValueError, match=words):
        read_record(Outer, GOOD | change)


@dataclass(frozen=True, eq=False)
class Series:
    values: Array
    error: Number
    share: float = 0.5

    @stored
    def count(self) -> int:
        return len(self.values)


def test_record_survives_writing_and_reading(tmp_path):
    """A record is read back as it was written."""
    kept = {"a": Series(np.array([1.0 / 3.0, np.nan]), np.inf), "b": Series(np.zeros((2, 1)), 2.0)}
    path = files.write_json(tmp_path / "r.json", kept)
    found = read_json(path, kind=Mapping[str, Series])
    assert plain(found["a"]) == {"values": [1.0 / 3.0, None], "error": None, "share": 0.5, "count": 2}
    np.testing.assert_array_equal(found["a"].values, kept["a"].values)
    np.testing.assert_array_equal(found["b"].values, kept["b"].values)
    assert np.isnan(found["a"].error) and found["b"].error == 2.0


def test_forbidden_nan_is_not_written(tmp_path):
    """A number that may not be NaN is not written."""
    with pytest.raises(CalibError, match=r"a\.share"):
        files.write_json(tmp_path / "r.json", {"a": Series(np.zeros(1), 0.0, np.nan)})
    assert not list(tmp_path.iterdir())
