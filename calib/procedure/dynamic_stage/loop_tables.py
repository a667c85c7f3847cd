"""What instruments from simulation say, for the folder of an identification."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from calib import files
from calib.identification.methods.bias import LoopTest
from calib.identification.methods.instrumental import Instrumental
from calib.simulation.loop.controllers import Controller

INSTRUMENTAL = "instrumental.csv"
HEADER = ("name", "unit", "instrumental", "sigma", "least_squares", "shift_sigma", "explained_percent")


def loop_table(bias: LoopTest, beside: bool = False) -> dict[str, Any] | None:
    """Return what ``metrics.json`` holds under ``loop``; None where no loop was stated.

    Args:
        beside: whether the estimate is another method's.
    """
    found, loops = bias.found, bias.loops
    notes = {"notes": list(loops.notes)} if loops is not None and loops.notes else {}
    if found is None:
        return ({"failure": bias.failure} if bias.failure else {}) | notes or None
    assert loops is not None  # the estimate came from them
    identified = loops.identified
    return notes | {
        "controller": controller_table(loops.controller),
        "controller_explains_percent": None if identified is None else _floats(identified.explained),
        "instruments": found.estimator.name,
        "beside": beside,
        "rounds": len(found.rounds),
        "retreats": sum(one.retreats for one in found.rounds),
        "durbin_wu_hausman": {
            "f": _number(found.verdict.statistic),
            "degrees": list(found.verdict.degrees),
            "p": found.verdict.p,
            "least_squares_biased": found.verdict.biased(),
        },
        "largest_shift_sigma": float(found.shift.max()),
        "cragg_donald": _number(found.strength.cragg_donald),
        "instruments_weak": found.strength.weak,
        "instruments_condition": _number(found.strength.condition),
        "least_partial_r2": float(found.strength.partial_r2.min()),
        "distance_percent": _floats(found.distance),
        "simulated_torque_error_percent": _floats(found.direct),
        "strays_times": _floats(found.stray),
        "valid": found.valid,
        "explains": found.explains,
    }


def controller_table(controller: Controller) -> dict[str, Any]:
    """Return gains and what surrounds them."""
    gains = {name: _floats(getattr(controller, name)) for name in ("kp", "kd", "ki", "limit")}
    return gains | {"delay": controller.delay, "feedforward": controller.ahead is not None}


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


def _floats(values: np.ndarray) -> list[float | None]:
    return [_number(x) for x in values]


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
