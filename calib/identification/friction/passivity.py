"""Passivity of friction: a model is physically inconsistent if the friction of a joint does not dissipate energy."""

from collections.abc import Sequence

import numpy as np

from calib.data.signals.motion import moving
from calib.dynamics.drives import DriveTerm
from calib.dynamics.shapes import TermMotion
from calib.errors import refuse_data
from calib.identification.prediction import Dynamics
from calib.identification.rows import Case, term_columns

MIN_ENERGY_SHARE = -0.01
"""Share of the energy that a joint moves: noise and other columns' shares stay above (our choice)."""
SPEEDS_PER_DIRECTION = 8
"""Speeds of each direction at which friction is to brake (our choice)."""


def _dissipated(dynamics: Dynamics, cases: Sequence[Case]) -> np.ndarray:
    """Return the share (n,) of each joint's energy that friction dissipates, ∫ v_j τ_friction,j dt / ∫ |v_j τ_j| dt.

    The share is zero for joints at rest; noise does not count as motion.

    Args:
        dynamics: model with its parameter values.
        cases: recordings.
    """
    model = dynamics.model
    n = model.n
    terms = []
    for term, value in zip(model.columns, dynamics.values[model.inertial :]):
        if term.form.dissipative and value != 0.0:
            terms.append((term, value))
    needs_load = any(term.form.loaded for term, _ in terms)
    dissipated = np.zeros(n)
    total = np.zeros(n)
    moves = np.zeros(n, dtype=bool)
    for case in cases:
        v = case.motion.v
        load = dynamics.transmitted(case) if needs_load else None
        measured = case.target[:, -n:]
        total += np.abs(v * measured).sum(axis=0)
        moves |= moving(case.motion).any(axis=0)
        for term, value in terms:
            for row, column in term_columns(term, case, load):
                dissipated[row] += value * float(v[:, row] @ column)
    share = dissipated / np.where(total > 0.0, total, 1.0)
    return np.where(moves & (total > 0.0), share, 0.0)


def braking(terms: Sequence[DriveTerm | None], fastest: np.ndarray) -> np.ndarray:
    """Return the rows A (c, p) of constraints A x >= 0 by which friction dissipates and motor inertia is positive.

    Friction must dissipate both without load and at unlimited load. Beyond the recorded speeds friction is linear
    (`calib.dynamics.shapes`), except for Stribeck's peak, which decays; so ten times the fastest speed represents all
    higher speeds.

    Args:
        terms: (p,) drive term of each column; None for parameters of bodies.
        fastest: (n,) largest recorded speeds [rad/s or m/s].
    """
    p = len(terms)
    unit_rows = np.eye(p)
    rows = []
    groups: dict[tuple[int, str, bool], list[int]] = {}
    for column, term in enumerate(terms):
        if term is None:
            continue
        if term.nonnegative:
            rows.append(unit_rows[column])
        if term.joint is not None and term.form.dissipative and not term.form.remembers:
            key = (term.joint, term.side, term.form.loaded)
            groups.setdefault(key, []).append(column)
    for (joint, _, _), columns in groups.items():
        group_terms = [(column, term) for column, term in enumerate(terms) if column in columns and term is not None]
        if all(term.nonnegative for _, term in group_terms):
            # Bounds of the single parameters are enough.
            continue
        speeds = fastest[joint] * np.append(np.geomspace(0.02, 1.0, SPEEDS_PER_DIRECTION), 10.0)
        v = np.concatenate([-speeds, speeds])
        zero = np.zeros_like(v)
        one_sign = np.ones_like(v)
        motion = TermMotion(zero, v, zero, one_sign, None)
        power = np.zeros((len(v), p))
        for column, term in group_terms:
            power[:, column] = term.values(motion) * np.sign(v)
        rows += list(power)
    return np.array(rows).reshape(-1, p)


def driving(dynamics: Dynamics, cases: Sequence[Case]) -> np.ndarray:
    """Return the mask (n,) of joints whose identified friction adds energy instead of dissipating it.

    Args:
        dynamics: model with its parameter values.
        cases: recordings, along which the energy is computed.
    """
    return np.asarray(_dissipated(dynamics, cases) < MIN_ENERGY_SHARE)


def driven(dynamics: Dynamics, cases: Sequence[Case]) -> tuple[int, ...]:
    """Return the joints, from 0, whose friction adds energy: their torques are reversed or exchanged between joints.

    Args:
        dynamics: model with its parameter values.
        cases: recordings, along which the energy is computed.

    Raises:
        MeasurementError: if the friction of most of the moving joints adds energy.
    """
    share = _dissipated(dynamics, cases)
    joints = np.flatnonzero(share < MIN_ENERGY_SHARE)
    if len(joints) and 2 * len(joints) > np.count_nonzero(share):
        numbers = ", ".join(str(joint + 1) for joint in joints)
        refuse_data(
            cases[0].motion.file,
            f"friction adds energy at joints {numbers}: the torques' sign is reversed, or "
            "positions and torques belong to different joints; reverse the sign (gains = [-1]), or check the columns",
        )
    return tuple(joints.tolist())
