"""JSON becomes what a dataclass says, or the message names the place."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pytest

from calib.records import read_record


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
        ({"name": 3}, "name: 3 where str belongs"),
        ({"inner": {}}, "inner.values is missing"),
        ({"inner": {"values": [1, "b"]}}, r"inner.values\[1\]: 'b' where float belongs"),
        ({"each": {"b": {"values": [True]}}}, r"each.b.values\[0\]: True where float belongs"),
        ({"inner": {"values": [], "pair": ["x"]}}, "inner.pair: 1 values where 2 belong"),
        ({"both": [1, 2.5]}, r"both\[1\]: 2.5 where int belongs"),
    ],
)
def test_what_does_not_belong_is_named_with_its_place(change, words):
    with pytest.raises(ValueError, match=words):
        read_record(Outer, GOOD | change)
