"""What instruments from simulation say, for the record and the folder of an identification."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from calib import files
from calib.estimation.instrumental_variables import ExogeneityTest
from calib.identification.methods.bias import LoopTest
from calib.identification.methods.instrumental import Instrumental
from calib.records import Array, Number
from calib.simulation.loop.controllers import Controller

INSTRUMENTAL = "instrumental.csv"
HEADER = ("name", "unit", "instrumental", "sigma", "least_squares", "shift_sigma", "explained_percent")


@dataclass(frozen=True, eq=False)
class LoopMetrics:
    """What instruments from a simulated loop say of an estimate; a record.

    Attributes:
        failure: why there are no instruments.
        notes: of the loops.
        instruments: the method that simulates; `beside`: whether the estimate is another method's.
        rounds: simulations until it settled.
        durbin_wu_hausman: whether least squares is biased.
        largest_shift_sigma: of a parameter from least squares.
        cragg_donald, instruments_weak, least_partial_r2: how strong the instruments are.
        distance_percent, simulated_torque_error_percent, strays_times: (n,) see `Instrumental`.
        valid, explains: whether the instruments may be trusted, and explain as much as the model.
        controller: that was simulated; of its torque, `controller_explains_percent` (n,) where it was identified.
    """

    failure: str = ""
    notes: tuple[str, ...] = ()
    instruments: str = ""
    beside: bool = False
    rounds: int = 0
    durbin_wu_hausman: ExogeneityTest | None = None
    largest_shift_sigma: float = 0.0
    cragg_donald: Number = 0.0
    instruments_weak: bool = False
    least_partial_r2: float = 0.0
    distance_percent: Array = ()  # type: ignore[assignment]
    simulated_torque_error_percent: Array = ()  # type: ignore[assignment]
    strays_times: Array = ()  # type: ignore[assignment]
    valid: bool = True
    explains: bool = True
    controller: Controller | None = None
    controller_explains_percent: Array | None = None

    @classmethod
    def of(cls, bias: LoopTest, beside: bool) -> LoopMetrics | None:
        """Return the record of a test by simulation; None where no loop was stated."""
        found, loops = bias.found, bias.loops
        notes = () if loops is None else loops.notes
        if found is None or loops is None:
            return cls(bias.failure, notes) if bias.failure or notes else None
        identified, strength = loops.identified, found.strength
        return cls(
            "", notes, found.estimator.name, beside, len(found.rounds), found.verdict, float(found.shift.max()),
            strength.cragg_donald, strength.weak, float(strength.partial_r2.min()), found.distance, found.direct,
            found.stray, found.valid, found.explains, loops.controller, identified and identified.explained,
        )  # fmt: skip


def write_instrumental(bias: LoopTest, folder: Path) -> None:
    """Write ``instrumental.csv``: both estimates of the standard model, parameter by parameter."""
    found = bias.found
    if found is not None:
        files.write_table(folder / INSTRUMENTAL, HEADER, list(_rows(found)))


def _rows(found: Instrumental) -> Iterator[tuple[Any, ...]]:
    estimate, plain = found.fit.estimate, found.ordinary.estimate.values
    for k, name in enumerate(estimate.names):
        yield (
            name, estimate.units[k], float(estimate.values[k]), float(estimate.sigma[k]), float(plain[k]),
            float(found.shift[k]), float(100.0 * found.strength.partial_r2[k]),
        )  # fmt: skip
