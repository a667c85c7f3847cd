"""Passivity of friction: every joint's friction dissipates energy, or the model is physically inconsistent."""

from collections.abc import Sequence

import numpy as np

from calib.data.signals.motion import moving
from calib.dynamics.drives import DriveTerm
from calib.dynamics.shapes import Joined
from calib.errors import refuse_data
from calib.identification.prediction import Dynamics
from calib.identification.rows import Case, term_columns

MIN_ENERGY_SHARE = -0.01  # of the energy that a joint moves: noise and other columns' shares stay above (our choice)


def _dissipated(dynamics: Dynamics, cases: Sequence[Case]) -> np.ndarray:
    """Return the energy dissipated by each joint's friction, ∫ v_j τ_friction,j dt, as a share of ∫ |v_j τ_j| dt, (n,).

    Joints that do not move have zero: noise moves none.
    """
    model = dynamics.model
    n, first = model.n, model.inertial
    terms = [
        (one, value)
        for one, value in zip(model.columns, dynamics.values[first:])
        if one.form.dissipative and value != 0.0
    ]
    taken, moved, moves = np.zeros(n), np.zeros(n), np.zeros(n, dtype=bool)
    for case in cases:
        v = case.motion.v
        load = dynamics.transmitted(case) if any(one.form.loaded for one, _ in terms) else None
        moved += np.abs(v * case.target[:, -n:]).sum(axis=0)
        moves |= moving(case.motion).any(axis=0)
        for one, value in terms:
            for row, values in term_columns(one, case, load):
                taken[row] += value * float(v[:, row] @ values)
    return np.where(moves & (moved > 0.0), taken / np.where(moved > 0.0, moved, 1.0), 0.0)


def braking(terms: Sequence[DriveTerm | None], fastest: np.ndarray) -> np.ndarray:
    """Return the rows A (c, p) of A x >= 0: friction of the p columns dissipates and motor inertia is positive.

    With and without load apart: the load's share grows without end. Beyond the speeds seen friction is linear
    (`calib.dynamics.shapes`) but for Stribeck's peak, which fades: ten times the fastest stands for all.

    Args:
        terms: (p,) behind the columns; None for parameters of bodies.
        fastest: (n,) speeds seen [rad/s or m/s].
    """
    p = len(terms)
    rows = [row for row, one in zip(np.eye(p), terms) if one is not None and one.nonnegative]
    groups: dict[tuple[int, str, bool], list[int]] = {}
    for k, one in enumerate(terms):
        if one is not None and one.joint is not None and one.form.dissipative and not one.form.remembers:
            groups.setdefault((one.joint, one.side, one.form.loaded), []).append(k)
    speeds_per_direction = 8  # of each direction at which friction is to brake (our choice)
    for (joint, _, _), members in groups.items():
        if all(one is not None and one.nonnegative for one in (terms[k] for k in members)):
            continue  # single bounds say it already
        speeds = fastest[joint] * np.append(np.geomspace(0.02, 1.0, speeds_per_direction), 10.0)
        v = np.concatenate([-speeds, speeds])
        seen = Joined(np.zeros_like(v), v, np.zeros_like(v), np.ones_like(v), None)
        block = np.zeros((len(v), p))
        for k in members:
            one = terms[k]
            assert one is not None
            block[:, k] = one.values(seen) * np.sign(v)
        rows += list(block)
    return np.array(rows).reshape(-1, p)


def driving(dynamics: Dynamics, cases: Sequence[Case]) -> np.ndarray:
    """Return the mask (n,) of joints whose identified friction adds energy."""
    return np.asarray(_dissipated(dynamics, cases) < MIN_ENERGY_SHARE)


def driven(dynamics: Dynamics, cases: Sequence[Case]) -> tuple[int, ...]:
    """Return the joints, from 0, whose friction adds energy: their torques are reversed, or belong to another joint.

    Raises:
        MeasurementError: where these are most of the joints that move.
    """
    share = _dissipated(dynamics, cases)
    found = np.flatnonzero(share < MIN_ENERGY_SHARE)
    if len(found) and 2 * len(found) > np.count_nonzero(share):
        named = ", ".join(str(joint + 1) for joint in found)
        refuse_data(
            cases[0].motion.file,
            f"friction adds energy at joints {named}: the torques' sign is reversed, or "
            "positions and torques belong to different joints; reverse the sign (gains = [-1]), or check the columns",
        )
    return tuple(int(joint) for joint in found)
