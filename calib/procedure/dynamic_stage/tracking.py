"""The second judgement of an identification: tracking with the model fed forward, in words and numbers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.markup import escape
from rich.table import Table

from calib.errors import CalibError
from calib.identification.loop.loop_settings import stated_controller
from calib.identification.loop.replay import CAD, DAMPING, FEEDBACK, FLOOR, FREQUENCY, IDENTIFIED, Replay, replay
from calib.identification.prediction import Dynamics
from calib.procedure.dynamic_stage.inputs import IdentificationInputs
from calib.procedure.dynamic_stage.loop_tables import controller_table
from calib.robot.chain import Chain
from calib.simulation.loop.controllers import Controller

MOST = 3  # recordings that are replayed
KEYS = {FEEDBACK: "feedback", CAD: "cad", IDENTIFIED: "model", FLOOR: "floor"}


@dataclass(frozen=True, eq=False)
class Tracking:
    """What replaying recordings came to.

    Attributes:
        replays: one per recording.
        unseen: whether these are motions that the fit has not seen.
        failure: why there is none.
    """

    replays: tuple[Replay, ...] = ()
    unseen: bool = False
    failure: str = ""


def track(
    inputs: IdentificationInputs,
    dynamics: Dynamics,
    predictions: Mapping[str, np.ndarray],
    controller: Controller | None = None,
) -> Tracking:
    """Replay unseen recordings (or, without any, one of the fit's own); see `calib.identification.loop.replay`.

    Args:
        predictions: case name → torques by the model.
        controller: that was identified, where the loop's is not stated.
    """
    chain, chosen = inputs.chain, list(inputs.unseen)[:MOST] or list(inputs.cases)[:1]
    loop = inputs.options.settings.loop if inputs.unit == "N m" else None
    read = None if loop is None else controller
    try:
        if loop is not None and loop.controller != "identify":
            read = stated_controller(loop, chain.n)
        rate = None if read is None or loop is None else loop.rate
        replays = tuple(replay(chain, dynamics, case, predictions[case.name], read, rate) for case in chosen)
    except CalibError as error:
        return Tracking(unseen=bool(inputs.unseen), failure=str(error))
    return Tracking(replays, bool(inputs.unseen))


def tracking_lines(tracking: Tracking, chain: Chain) -> Iterator[Table | str]:
    """Say how far the simulated robot strays, and what that means."""
    if tracking.failure:
        yield escape(f"tracking with the model fed forward was not simulated: {tracking.failure}")
    if not tracking.replays:
        return
    table = Table(
        "file", "tracking, simulated", title=escape("rms of q - reference [mrad or mm]"), title_justify="left"
    )
    for joint in range(chain.n):
        table.add_column(f"{joint + 1}", justify="right")
    for one in tracking.replays:
        for name, rms in one.rms.items():
            table.add_row(escape(one.name), name, *(f"{1e3 * x:.3g}" for x in rms))
    yield table
    first = tracking.replays[0]
    if first.added.any():
        shown = " ".join(f"{x:.2g}" for x in first.added)
        yield (
            f"the identified model is no possible robot: it is simulated with motor inertia added, {shown} kg m² (kg); "
            "compare the rows, do not trust their size"
        )
    control = (
        "the controller of [loop]" if first.stated else f"a PD of {FREQUENCY:g} Hz, damping {DAMPING:g} (our default)"
    )
    motion = "motion the fit has not seen" if tracking.unseen else "the motion of the fit itself, which flatters"
    yield escape(
        f"the simulated robot is the identified model, disturbed by the torque it left unexplained; {control}; "
        f"{motion}: feeding the model forward divides the tracking error by {first.gain:.3g}"
    )


def tracking_table(tracking: Tracking) -> dict[str, Any] | None:
    """Return what ``metrics.json`` holds under ``tracking``; rms in rad or m."""
    if tracking.failure:
        return {"failure": tracking.failure}
    if not tracking.replays:
        return None
    return {
        one.name: {
            "rms": {KEYS[name]: [float(x) for x in rms] for name, rms in one.rms.items()},
            "feedback_over_model": one.gain,
            "unseen": tracking.unseen,
            "seconds": one.seconds,
            "controller": controller_table(one.controller) | {"stated": one.stated},
            "terms_left_out": list(one.left_out),
            "inertia_added": [float(x) for x in one.added],
        }
        for one in tracking.replays
    }
