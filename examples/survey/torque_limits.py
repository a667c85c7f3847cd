"""Share of time in which fed-back encoder noise drives a condition's robot to its torque limits.

    python examples/survey/torque_limits.py [MCS-RV2SQ-1-3 …]

A method that simulates the loop without noise never meets those limits: where they act, it believes a stiffer loop than
the one that moved. Prints the share of control periods at the limit, joint by joint [%], with the noise and without.
"""

from __future__ import annotations

import sys

import numpy as np

from calib.apps.studies.conditions import read_study
from calib.apps.studies.experiment import set_up
from calib.identification.closed_loop.simulation import Sensing, simulate
from calib.simulation import known_robots

# share of the torque limit from which a joint is at it
LIMIT_SHARE = 0.999


def main() -> None:
    for condition in read_study(sys.argv[1:] or ["MCS-RV2SQ-1-3"]).conditions:
        setup = set_up(condition)
        controller = known_robots.controller(condition.robot)
        limit = LIMIT_SHARE * np.asarray(controller.limit)
        for label, sigma in (("with encoder noise", condition.sigma_q), ("without", 0.0)):
            run = simulate(setup.plant, controller, setup.reference, Sensing(sigma), np.random.default_rng(0))
            limited = np.abs(run.torque) >= limit
            share = 100.0 * np.mean(limited, axis=0)
            print(f"{condition.name}, {label}: {np.round(share, 1)}")


if __name__ == "__main__":
    main()
