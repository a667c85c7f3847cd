"""Hypothesis strategies: names as people type them, and serial chains of any kind."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from calib.robot.chain import Chain, Element, Joint
from calib.transforms import from_xyz_rpy

AXES = ("tx", "ty", "tz", "rx", "ry", "rz")


def names(most: int = 12) -> st.SearchStrategy[str]:
    """Draw names with commas, quotes, blanks, brackets, markup, letters of any script; no control characters."""
    awkward = st.text(st.sampled_from(list(",;\"'`<>&$[](){}#=\\/ äßλ中🤖.-_abXY12")), min_size=1, max_size=most)
    letters = st.text(st.characters(exclude_categories=["C", "Z"]), min_size=1, max_size=most)
    return st.one_of(awkward, letters).map(str.strip).filter(bool)


def column_names(most: int = 12) -> st.SearchStrategy[str]:
    """Draw names that a header can hold: no brackets at the end, which are a unit's, and no numbers."""
    return names(most).filter(lambda name: not name.endswith("]") and not _is_number(name))


def _is_number(name: str) -> bool:
    try:
        float(name)
    except ValueError:
        return False
    return True


def finite(size: float) -> st.SearchStrategy[float]:
    return st.floats(-size, size, allow_nan=False, allow_subnormal=False)


@st.composite
def chains(draw: st.DrawFn, name: st.SearchStrategy[str] | None = None, inertias: bool = False) -> Chain:
    """Draw an arm of one to four joints, revolute and prismatic, on random constant transforms."""
    name = name or names()
    n = draw(st.integers(1, 4))
    labels = draw(st.lists(name, min_size=n, max_size=n, unique=True))
    joints, elements = [], []
    for k, label in enumerate(labels):
        kind = draw(st.sampled_from(["revolute", "prismatic"]))
        lower = draw(finite(3.0))
        joints.append(Joint(label, kind, lower, lower + draw(st.floats(0.1, 3.0)), velocity=2.0, effort=50.0))
        placement = None
        if draw(st.booleans()):
            placement = from_xyz_rpy([draw(finite(1.0)) for _ in range(3)], [draw(finite(3.0)) for _ in range(3)])
        for axis in draw(st.lists(st.sampled_from(AXES), max_size=3)):
            elements.append(Element(f"{label}.{axis}{len(elements)}", axis, draw(finite(1.0)), owner=k))
        axis = ("r" if kind == "revolute" else "t") + draw(st.sampled_from("xyz"))
        sign = draw(st.sampled_from([1.0, -1.0]))
        elements.append(
            Element(f"{label}.q", axis, draw(finite(1.0)), owner=k, joint=k, sign=sign, placement=placement)
        )
    bodies = np.tile([0.1, 0, 0, 0.1, 0, 0.1, 0.2, 0.0, 0.1, 2.0], (n, 1)) if inertias else None
    tail = from_xyz_rpy([draw(finite(1.0)) for _ in range(3)], [draw(finite(1.5)) for _ in range(3)])
    return Chain(draw(name), tuple(joints), tuple(elements), tail=tail, inertias=bodies)
