"""The second judgement of an identification: tracking with the model fed forward, in numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.errors import CalibError
from calib.identification.loop.replay import CAD, FEEDBACK, FLOOR, IDENTIFIED, Replay, replay
from calib.identification.prediction import Dynamics
from calib.procedure.dynamic_stage.inputs import IdentificationInputs
from calib.procedure.dynamic_stage.loop_tables import controller_table
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
            read = loop.stated_controller(chain.n)
        rate = None if read is None or loop is None else loop.rate
        replays = tuple(replay(chain, dynamics, case, predictions[case.name], read, rate) for case in chosen)
    except CalibError as error:
        return Tracking(unseen=bool(inputs.unseen), failure=str(error))
    return Tracking(replays, bool(inputs.unseen))


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
