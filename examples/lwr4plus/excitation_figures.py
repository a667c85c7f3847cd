"""Pictures of the excitation study, after Figs 5 and 6 of Kolyubin, Shiriaev & Jubien (2019)."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from calib.procedure.report.style import AFTER, BEFORE, MARK, QUIET, WIDE, sheet, styled
from calib.robot.chain import Chain
from calib.robot.kinematics import forward
from trajectories.basis import SampledMotion

ESSENTIAL = (
    "Ia1", "Fvm1", "Fcm1", "Ia2", "Fvm2", "Fcm2", "Ia3", "Fvm3", "Fcm3", "Fvm4", "Ia5", "Fvm5", "Fcm5", "Ia6", "Fvm6",
    "Fcm6", "Ia7", "Fvm7", "Fcm7", "offm7", "Fcl1", "Fcl2", "offl2", "Fcl3", "Fcl4", "offl4", "Fcl5", "offl5", "Fcl7",
    "offl7", "XX2R", "ZZ2R", "MY2R", "XX4R", "ZZ4R", "MY4R", "MY5R", "MY6R",
)  # fmt: skip
"""The paper's Table 4 without its payload."""


def paths(chain: Chain, motions: dict[str, SampledMotion]) -> Figure:
    """Draw the tool's path of every motion in space."""
    with styled():
        columns = min(len(motions), 3)
        figure = Figure(figsize=(WIDE, 2.6 * -(-len(motions) // columns)))
        for k, (name, motion) in enumerate(motions.items()):
            axis: Any = figure.add_subplot(-(-len(motions) // columns), columns, k + 1, projection="3d")
            place = forward(chain, motion.q)[:, :3, 3]
            axis.plot(*place.T, color=AFTER, linewidth=0.7)
            axis.set_title(name)
            axis.set(xlim=(-0.9, 0.9), ylim=(-0.9, 0.9), zlim=(-0.3, 0.9), box_aspect=(1.5, 1.5, 1.0))
            axis.tick_params(labelsize=5)
    return figure


def estimates(found: dict[str, Any]) -> Figure:
    """Draw the identified error of the essential parameters: CAD and calibrated geometry, random path and optimised."""
    names = [name for name in found["names"] if name in ESSENTIAL]
    names = names or [name for name in found["names"] if name.rstrip("R") != name or name[:2] in ("Fv", "Fc", "Ia")]
    index = [found["names"].index(name) for name in names]
    colors = dict(zip(found["rows"], (BEFORE, QUIET, MARK, AFTER)))
    with styled():
        figure, (axis,) = sheet(width=WIDE, height=3.2)
        for k, (name, row) in enumerate(found["rows"].items()):
            place = np.arange(len(index)) + 0.2 * (k - 1.5)
            axis.bar(place, np.array(row["error"])[index], 0.2, color=colors[name], label=name)
        axis.set(yscale="log", ylabel="error of the estimate [%]")
        axis.set_xticks(range(len(index)), names, rotation=90, fontsize=6)
        axis.legend(ncols=2, fontsize=7)
    return figure
