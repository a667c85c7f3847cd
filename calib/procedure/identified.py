"""An identified model read back from its folder: ``robot.toml`` and ``dynamics.json`` (`identification_outputs`)."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from calib.dynamics.drives import Term
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.tree import tree, with_gravity, with_payload
from calib.errors import CalibError, UsageError
from calib.identification.prediction import Dynamics
from calib.robot.chain import Chain
from calib.robot.load import load


def read(folder: Path, carried: Collection[str] = ()) -> tuple[Chain, Dynamics]:
    """Return the chain of an identification, and its model with numbers.

    Args:
        carried: labels of the payloads on board; columns of the others are left out.

    Raises:
        UsageError: for a folder that holds no identification, or one that does not hold together.
    """
    place = folder / "dynamics.json"
    if not place.is_file():
        raise UsageError(f"{folder} holds no dynamics.json; --model wants the folder that calib identify wrote")
    chain = load(folder)
    try:
        table = json.loads(place.read_text(encoding="utf-8"))
        return chain, _dynamics(chain, table, carried, str(place))
    except (json.JSONDecodeError, KeyError, TypeError, ValueError, IndexError) as error:
        raise UsageError(f"{place} is damaged ({error!r}); run calib identify again") from error


def _dynamics(chain: Chain, table: Mapping[str, Any], carried: Collection[str], where: str) -> Dynamics:
    if unknown := sorted(set(carried) - set(table["payloads"])):
        known = ", ".join(table["payloads"]) or "none"
        raise UsageError(f"{where}: no payload '{unknown[0]}' was identified; it knows {known}")
    bodies = with_gravity(tree(chain), np.array(table["gravity"], dtype=float))
    for label in table["payloads"]:
        bodies = with_payload(bodies, chain.tail, label) if label in carried else bodies
    terms = tuple(_term(entry) for entry in table["terms"])
    if missing := sorted(set(bodies.names) - set(table["bodies"])):
        raise UsageError(f"{where}: the value of {missing[0]} is missing; it belongs to another robot.toml")
    values = [*(table["bodies"][name] for name in bodies.names), *(entry["value"] for entry in table["terms"])]
    values = np.array(values, dtype=float)
    model = IdentificationModel(bodies, terms, table["kind"])
    if len(values) != model.p:
        raise CalibError(f"{where}: {len(values)} values for {model.p} parameters")
    if not np.isfinite(values).all():
        raise UsageError(f"{where}: the value of {model.names[int(np.argmin(np.isfinite(values)))]} is not a number")
    return Dynamics(model, values)


def _term(entry: Mapping[str, Any]) -> Term:
    acts = tuple((int(row), tuple((int(j), float(w)) for j, w in motion)) for row, motion in entry["acts"])
    settings = tuple(float(x) for x in entry["settings"])
    return Term(entry["name"], entry["shape"], acts, settings, entry["side"], bool(entry["linear"]))
