"""The second judgement of an identification: tracking with the model fed forward, in numbers."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from calib.errors import CalibError
from calib.identification.loop.replay import Replay, replay
from calib.identification.prediction import Dynamics
from calib.procedure.dynamic_stage.inputs import IdentificationInputs
from calib.simulation.loop.controllers import Controller

MAX_REPLAYS = 3  # recordings that are replayed


@dataclass(frozen=True, eq=False)
class Tracking:
    """What replaying recordings came to.

    Attributes:
        replays: one per recording.
        failure: why there is none.
    """

    replays: tuple[Replay, ...] = ()
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
    chain, chosen = inputs.chain, list(inputs.unseen)[:MAX_REPLAYS] or list(inputs.cases)[:1]
    loop = inputs.options.settings.loop if inputs.unit == "N m" else None
    read = None if loop is None else controller
    try:
        if loop is not None and loop.controller != "identify":
            read = loop.stated_controller(chain.n)
        rate = None if read is None or loop is None else loop.rate
        replays = (replay(chain, dynamics, case, predictions[case.name], read, rate) for case in chosen)
        return Tracking(tuple(replace(one, unseen=bool(inputs.unseen)) for one in replays))
    except CalibError as error:
        return Tracking(failure=str(error))
