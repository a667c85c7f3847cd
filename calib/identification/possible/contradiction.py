"""Does an estimate contradict every robot that can exist? Its distance from the nearest one, where it is large.

Where the model is right, 95 % of all estimates are within √χ²(b) of a possible robot. Honest recordings are farther:
friction of another form has no place in a possible body, and the data's sigmas do not know of it. Only a distance
several times that bound points to signs, orders and robots; what it means is for a verdict to say.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from calib.dynamics.idim import IdentificationModel
from calib.errors import NotConverged
from calib.identification.possible import nearest as border
from calib.identification.possible.information import of
from calib.identification.possible.prior_bodies import find_prior_bodies
from calib.identification.possible.problem import make_problem
from calib.identification.possible.solve import bound, solve
from calib.robot.chain import Chain

if TYPE_CHECKING:
    from calib.identification.identify import Identification


@dataclass(frozen=True)
class Contradiction:
    """How far an estimate is from the nearest possible robot.

    Attributes:
        distance: in standard deviations (Mahalanobis); up to `max_times` times `allowed` that of a robot near it.
        allowed: what it stays below in 95 % of all cases where the model is right.
        unexplained: of the torques, in weighted rows, that the nearest possible robot leaves beside the estimate [%].
    """

    distance: float
    allowed: float
    unexplained: float


def contradiction(found: Identification, chain: Chain) -> Contradiction | None:
    """Return how far an estimate is from what can exist; None where its rows hold no bodies, or nothing was found.

    Args:
        found: the estimate, of torques.
        chain: the robot it was identified on.
    """
    model = found.dynamics.model
    if not isinstance(model, IdentificationModel) or not model.torque_rows.has_bodies:
        return None
    information = of(found, chain)
    allowed = bound(information.b)
    problems = [make_problem(information, one) for one in find_prior_bodies(chain, model)]

    def distances() -> Iterator[float]:
        for problem in problems[: max(len(problems) - 1, 1)]:
            try:
                yield information.distance(border.nearest(problem))
            except NotConverged:
                continue

    weight = 1.0  # γ that hardly draws, yet keeps Newton's steps off the border: its distance is at most a tenth larger
    try:
        away = information.distance(solve(problems[-1], weight))
    except (NotConverged, ValueError):  # the latter where curvatures overflow
        away = np.inf
    max_times = 3.0  # times the bound, up to which no semidefinite program is solved for the last tenth
    if away > max_times * allowed:
        away = min((away, *distances()))
    if not np.isfinite(away):
        return None
    return Contradiction(float(away), allowed, 100.0 * float(away) / float(np.linalg.norm(information.factor[:, -1])))
