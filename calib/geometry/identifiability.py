"""Which geometric parameters the poses can identify, and what merges with what, in words."""

from collections.abc import Sequence

import numpy as np

from calib.estimation.base_columns import ColumnSplit, split_columns
from calib.geometry.installation import Installation
from calib.geometry.observation import Block, observe
from calib.geometry.parameters import layout


def observation_matrix(cell: Installation, blocks: Sequence[Block], columns: np.ndarray) -> np.ndarray:
    """Return W (rows, c) of all blocks, stated sigmas applied, otherwise metres against radians times the reach.

    The reach (rms distance of targets from the arm's base) makes orientation rows comparable with position rows.
    """
    rows = []
    for block in blocks:
        for part in observe(cell, block, columns):
            scale = part.sigma
            if part.label == "pixel":
                scale = np.asarray(part.per_length)
            elif scale is None:
                scale = np.full(part.value.shape, 1.0 / _reach(cell) if part.label == "orientation" else 1.0)
            elif part.label != "orientation":
                scale = scale / np.median(scale)
            else:
                scale = scale / np.median(scale) / _reach(cell)
            rows.append(part.whitened(scale)[1])
    return np.concatenate(rows)


def _reach(cell: Installation) -> float:
    """Return a length typical of the arm [m]: the sum of its constant offsets."""
    total = sum(abs(e.value) for e in cell.chain.elements if e.axis[0] == "t")
    total += sum(float(np.linalg.norm(e.placement[:3, 3])) for e in cell.chain.elements if e.placement is not None)
    return max(total, 0.1)


def _preference(cell: Installation, columns: np.ndarray) -> list[np.ndarray]:
    """Return groups of columns, first choice first: frames, joint offsets, rotations, translations, deflections.

    Frames come first, so that what cannot be distinguished from the installation (the first joint's placement, the last
    joint's offset) stays with the installation and the arm keeps its nominal there. Rotations before translations make
    Hayati's β win over an offset along parallel axes.
    """
    table = layout(cell)
    moving = {e.name for e in cell.chain.elements if e.joint is not None}
    kinds: list[list[int]] = [[], [], [], [], []]
    for place, column in enumerate(columns):
        group = table.group(int(column))
        if group in ("station", "tool", "optics"):
            kinds[0].append(place)
        elif group == "deflection":
            kinds[4].append(place)
        elif table.names[column] in moving:
            kinds[1].append(place)
        else:
            kinds[2 if table.units[column] == "rad" else 3].append(place)
    return [np.array(kind, dtype=int) for kind in kinds]


def base_columns(
    cell: Installation, blocks: Sequence[Block], columns: np.ndarray, tolerance: float = 1e-5
) -> ColumnSplit:
    """Split candidate parameters into identifiable ones and those that merge with them; indices into `columns`."""
    return split_columns(observation_matrix(cell, blocks, columns), _preference(cell, columns), tolerance)
