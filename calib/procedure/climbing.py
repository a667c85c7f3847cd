"""The one seam to the ladder of models (`calib.geometry.ladder`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from calib.data.measurements import PoseMeasurements
from calib.data.options import FitOptions
from calib.geometry.fit import GeometricFit, Settings, fit, polish_frames
from calib.geometry.installation import Installation


@dataclass(frozen=True)
class Rung:
    model: str
    parameters: int
    cross_validated: float | None
    note: str = ""


@dataclass(frozen=True, eq=False)
class Climb:
    fit: GeometricFit
    nominal: GeometricFit
    rungs: list[Rung]
    chosen: str

    def unclear(self) -> tuple[str, ...]:
        return ()


def climb(
    cell: Installation,
    measured: Sequence[PoseMeasurements],
    model: str,
    options: FitOptions,
    settings: Settings,
    torques: list[np.ndarray | None],
    seed: int,
    say: Callable[[str], None],
) -> Climb:
    """Fit the model asked for, or the best by cross-validation."""
    nominal = polish_frames(cell, measured, settings, torques)
    if model == "frames":
        return Climb(nominal, nominal, [Rung("frames", len(nominal.free), None)], "frames")
    found = fit(nominal.cell, measured, settings=settings, torques=torques)
    return Climb(found, nominal, [Rung("geometry", len(found.free), None)], "geometry")
