"""``parameters.json``: all parameters of an identified robot with units and covariances."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from calib.procedure.export.identified import IdentifiedRobot
from calib.robot.calibrated import nominal_of


def parameters(given: IdentifiedRobot) -> dict[str, Any]:
    """Return the content of ``parameters.json``."""
    estimate, found, chain = given.information, given.found, given.chain
    model = found.dynamics.model
    covariance = given.robot.covariance
    return {
        "robot": chain.name,
        "geometry": {
            **_columns(chain.names, chain.units, chain.values),
            "nominal": nominal_of(given.robot).values.tolist(),
            "covariance": None if covariance is None else np.asarray(covariance).tolist(),
        },
        "dynamics": {
            "gravity": model.bodies.gravity.tolist(),
            "rows": model.torque_rows.name,
            "base": {
                **_columns(estimate.names, estimate.units, estimate.values),
                "covariance": estimate.covariance.tolist(),
            },
            "standard": {
                **_columns(model.names, model.units, found.dynamics.values),
                "covariance": found.covariance.tolist(),
                "frames": "about the chain's frame behind each joint (robot.toml), payloads about the tip",
            },
            "consistency": {
                "possible": found.possible,
                "nearest": found.nearest,
                "distance": found.distance,
                "allowed": found.allowed,
                "margins_m": dict(zip(model.bodies.labels, found.margins.tolist())),
                "weight": found.weight,
                "prior": found.prior,
                "sigmas_widened_by": found.doubt,
                "drawn_to": found.source,
                "blamed": dict(found.blamed),
                "notes": list(found.notes),
            },
        },
    }


def _columns(names: Sequence[str], units: Sequence[str], values: np.ndarray) -> dict[str, Any]:
    return {"names": list(names), "units": list(units), "values": np.asarray(values).tolist()}
