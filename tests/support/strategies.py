"""Hypothesis strategies: names as people type them, serial chains of any kind, files as they arrive."""

import re

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
    return names(most).filter(lambda name: not name.endswith(("]", ")")) and not _is_number(name))


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


ODD_CELLS = (
    "nan", "inf", "-inf", "1e400", "1e-400", "0_5", "０.５", "", "-", "+", "1,5", '"', "1;2", "0x10", "true", "1e5",
    "\t", "\0", "9" * 400, "é", "=1+1", "(", "{", "[", "<a", "]]>", "&amp;", "$q$", "-0", "1 2", "'", "null",
)  # fmt: skip


@st.composite
def damaged(draw: st.DrawFn, content: bytes) -> bytes:
    """Draw what may become of a file: cut off, bytes changed, parts doubled or lost, odd cells, other encodings."""
    for _ in range(draw(st.integers(1, 3))):
        size = len(content)
        a, b = sorted((draw(st.integers(0, size)), draw(st.integers(0, size))))
        match draw(st.sampled_from(["cell", "cut", "flip", "lose", "double", "junk", "encode", "line"])):
            case "cell":
                numbers = list(re.finditer(rb"-?\d+\.?\d*(e-?\d+)?|[A-Za-z_]\w*", content))
                if numbers:
                    found = draw(st.sampled_from(numbers))
                    odd = draw(st.sampled_from(ODD_CELLS)).encode()
                    content = content[: found.start()] + odd + content[found.end() :]
            case "cut":
                content = content[:a]
            case "flip":
                content = content[:a] + bytes([draw(st.integers(0, 255))]) + content[a + 1 :]
            case "lose":
                content = content[:a] + content[min(b, a + 200) :]
            case "double":
                content = content[:b] + content[a : min(b, a + 200)] + content[b:]
            case "junk":
                content = content[:a] + draw(st.binary(max_size=20)) + content[a:]
            case "encode":
                text = content.decode("utf-8", "replace")
                content = text.encode(draw(st.sampled_from(["utf-16", "latin-1", "utf-8-sig"])), "replace")
            case "line":
                content = content.replace(b"\n", draw(st.sampled_from([b"\r\n", b"\r", b"\n\n", b",\n", b""])))
    return content
