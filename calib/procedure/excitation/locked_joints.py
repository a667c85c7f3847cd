"""Joints that stay while the others move, and the columns that are then left to tell apart.

A joint at rest feels stiction, any value up to Coulomb's: its torque row tells nothing and is left out. Of the model's
base columns those stay that the other rows tell, together with motions recorded before; they are chosen in order, so
that a column that folds into others stands for what it and they have in common while that joint stays where it is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib.dynamics import base
from calib.errors import UsageError
from calib.estimation.base_columns import split_columns
from calib.procedure.excitation.model import ExcitedModel
from calib.robot.chain import Chain
from trajectories.constraints import BoxLimit

INDEPENDENT = 1e-4  # of a column at unit norm that no other one explains (our choice)


@dataclass(frozen=True, eq=False)
class IdentifiableColumns:
    """What the motion can tell.

    Attributes:
        columns: (c,) of the model's; None: all of them.
        sigmas: (n,) infinite for rows that tell nothing; None: all rows tell.
        names: of the columns; notes: what a user should know.
    """

    columns: np.ndarray | None
    sigmas: np.ndarray | None
    names: tuple[str, ...]
    notes: tuple[str, ...] = ()


def read_held(texts: Sequence[str], chain: Chain, limits: BoxLimit) -> dict[int, float | None]:
    """Return the joints that stay: with the value said (``joint4=0.5``, rad or m), or where the search likes it (None).

    Raises:
        UsageError: for a joint that is not there, a value beyond its limits, or when none is left to move.
    """
    known = {f"{word}{j + 1}": j for word in ("joint", "q") for j in range(chain.n)}
    known |= {name: j for j, name in enumerate(chain.joint_names)}
    found: dict[int, float | None] = {}
    for text in [part.strip() for word in texts for part in word.split(",")]:
        name, _, amount = (part.strip() for part in text.partition("="))
        if name not in known:
            raise UsageError(f"--lock {text}: '{name}' is no joint; there are {', '.join(chain.joint_names)}")
        j = known[name]
        try:
            value = float(amount) if amount else None
        except ValueError:
            raise UsageError(f"--lock {text}: '{amount}' is not a number") from None
        lower, upper = limits.lower[j], limits.upper[j]
        if value is not None and not lower <= value <= upper:
            raise UsageError(
                f"--lock {text}: {chain.joint_names[j]} at {value:g} is beyond its limits {lower:.4g} to {upper:.4g}"
            )
        found[j] = value
    if len(found) == chain.n:
        raise UsageError("--lock: every joint is locked; nothing is left to move")
    return found


def told(
    dynamics: ExcitedModel, chain: Chain, held: Mapping[int, float | None], existing: np.ndarray | None = None
) -> IdentifiableColumns:
    """Return which columns a motion with these joints held can tell apart.

    Args:
        existing: (b, b) information of motions recorded before.
    """
    names = dynamics.exact.names
    if not held:
        return IdentifiableColumns(None, None, names)
    n = chain.n
    sigmas = np.where(np.isin(np.arange(n), list(held)), np.inf, 1.0)
    lower, upper = (np.where(np.isfinite(x), x, s * np.pi) for x, s in ((chain.lower, -1.0), (chain.upper, 1.0)))
    states = base.random_samples(dynamics.exact.model, lower=lower, upper=upper)
    q, v, a = (np.array(x) for x in (states.q, states.v, states.a))
    for j, value in held.items():
        q[:, j], v[:, j], a[:, j] = q[0, j] if value is None else value, 0.0, 0.0
    Y = dynamics.exact.regressor(q, v, a) / sigmas[:, None]
    rows = Y.reshape(-1, Y.shape[-1])
    if existing is not None:
        values, V = np.linalg.eigh(existing)
        rows = np.concatenate([rows, np.sqrt(np.maximum(values, 0.0))[:, None] * V.T])
    kept = split_columns(rows, [np.array([k]) for k in range(rows.shape[1])], INDEPENDENT).kept
    still = ", ".join(chain.joint_names[j] for j in held)
    gone = [name for k, name in enumerate(names) if k not in set(kept.tolist())]
    note = (
        f"held: {still}; a held joint's torque is stiction in part and is left out; {len(kept)} of {len(names)} "
        f"columns can be told ({len(gone)} fold into others or vanish: {', '.join(gone[:12])}"
        f"{', ...' if len(gone) > 12 else ''})"
    )
    return IdentifiableColumns(np.asarray(kept), sigmas, tuple(names[k] for k in kept), (note,) if gone else ())
