"""What the geometry's uncertainty does to an identification, as tables, as metrics and in words.

Beside what every identification writes (``calib identify --out``)::

    estimate.csv          sigma and rsd are totals; sigma_torque is the part of the torques' noise, sigma_geometry that
                          of the geometry, empty where the robot came without a covariance (no folder of a fit)
    covariance.csv        total: Sigma_torque + S Sigma_geometry S'
    sensitivity.csv       S: change of each parameter per m or rad of each element of the chain, and per rad of tilt of
                          gravity about the base's x and y axes (gravity.rx, gravity.ry)
    geometry_effects.csv  the elements ranked by what one sigma of theirs does: the parameter that moves most, by how
                          many of its sigma_torque, and the rms of the torque before and after re-estimation; without a
                          sigma: not fitted (a choice of frames, or not told by the poses), effect of 1 mm or 1 mrad
    geometries.csv        each parameter on the nominal and on the calibrated geometry, from the same torques
    chain_covariance.csv  that of the fit, for whoever goes on from this folder
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calib import files
from calib.identification.uncertainty.geometry_uncertainty import NOTHING, TILTS, GeometryUncertainty
from calib.identification.uncertainty.two_geometries import GeometryComparison
from calib.procedure.dynamic_stage.identify import IdentificationOutcome
from calib.procedure.dynamic_stage.metrics import GeometricEffect, TwoGeometries

EFFECTS, SENSITIVITY, GEOMETRIES = "geometry_effects.csv", "sensitivity.csv", "geometries.csv"
LEAST = float(np.sqrt((1.0 + NOTHING) ** 2 - 1.0))  # a shift, in σ_torque, that raises a σ by more than `NOTHING`


def write(outcome: IdentificationOutcome, folder: Path) -> None:
    """Write sensitivities, the ranked effects and the two geometries' estimates."""
    carried = outcome.carried
    if carried is None:
        return
    rows = ([name, *map(float, row)] for name, row in zip(carried.names, carried.sensitivity))
    header = [f"{name} [{unit}]" for name, unit in zip(carried.elements, carried.units)]
    files.write_table(folder / SENSITIVITY, ("name", *header), rows)
    files.write_table(folder / EFFECTS, GeometricEffect._fields, effects(carried))
    if outcome.geometries is not None:
        table = _geometries(outcome.geometries, _essential_names(outcome))
        files.write_table(folder / GEOMETRIES, TwoGeometries._fields, table)


def _ranking(carried: GeometryUncertainty) -> np.ndarray:
    """Return the elements' indices: by the largest shift that one σ of theirs causes, then the ones without any σ."""
    known = np.isfinite(carried.deviations)
    unit = _per_sigma(carried).max(axis=0, initial=0.0)
    size = np.where(known, unit * np.where(known, carried.deviations, 0.0), unit)
    return np.lexsort((-size, ~known))


def effects(carried: GeometryUncertainty) -> list[GeometricEffect]:
    """Return the rows of ``geometry_effects.csv``, the most harmful element first.

    shift_sigma: of the parameter that moves most, by one σ of the element, in that parameter's σ from torque noise;
    shift_sigma_per_milli: by 1 mm or 1 mrad. torque_rms: what one σ does to the rigid torque at fixed parameters;
    torque_rms_left: after the parameters have been estimated anew. An element matters where it alone raises some σ by
    more than 1 %; without a σ nothing can be said.
    """
    found, units = [], _per_sigma(carried)
    for rank, k in enumerate(_ranking(carried), start=1):
        per_unit = units[:, k]
        worst, sigma = int(np.argmax(per_unit)), carried.deviations[k]
        known = bool(np.isfinite(sigma))
        shifts = per_unit * sigma
        found.append(
            GeometricEffect(
                rank, carried.elements[k], carried.units[k], float(sigma) if known else None,
                ("yes" if shifts.max() > LEAST else "no") if known else "",
                carried.names[worst] if per_unit[worst] > 0.0 else "",
                float(shifts[worst]) if known else None, int((shifts > LEAST).sum()) if known else None,
                float(carried.felt[k] * sigma) if known else None, float(carried.left[k] * sigma) if known else None,
                float(1e-3 * per_unit[worst]),
            )
        )  # fmt: skip
    return found


def _geometries(found: GeometryComparison, essential: Sequence[str]) -> list[TwoGeometries]:
    """Return the rows of ``geometries.csv``: each parameter on the nominal and on the calibrated geometry."""
    return [
        TwoGeometries(
            name, unit, float(first), float(s_first), float(second), float(s_second),
            float(relative) if np.isfinite(relative) else None, float(apart), "yes" if name in essential else "no",
        )
        for name, unit, first, second, s_first, s_second, relative, apart in zip(
            found.names, found.units, *found.values, *found.sigma, found.relative, found.difference
        )
    ]  # fmt: skip


def _essential_names(outcome: IdentificationOutcome) -> tuple[str, ...]:
    """Return the names of the essential parameters; all, where none were left out."""
    found = outcome.found
    if found.elimination is None:
        return found.names
    own = dict(zip(found.elimination.base.estimate.names, found.names))
    return tuple(own[name] for name in found.elimination.essential.estimate.names)


def metrics(carried: GeometryUncertainty | None, compared: GeometryComparison | None) -> dict[str, Any] | None:
    """Return the entry ``geometry`` of ``metrics.json``."""
    if carried is None:
        return None
    growth = carried.sigma / np.where(carried.sigma_torque > 0.0, carried.sigma_torque, 1.0)
    return {
        "propagated": carried.geometry is not None,
        "summary": summary(carried),
        "parameters": len(carried.names),
        "changed": [name for name, yes in zip(carried.names, carried.changed) if yes],
        "geometry_exceeds_torque": [name for name, yes in zip(carried.names, carried.dominated) if yes],
        "moved_by_1_mrad_of_tilt": {"parameter": _tilt(carried)[0], "sigmas": _tilt(carried)[1]},
        "largest_growth_of_sigma": float(growth.max(initial=1.0)),
        "largest_changes_from_nominal": [] if compared is None else _largest(compared),
    }


def summary(carried: GeometryUncertainty) -> str:
    """Say in a sentence what the geometry's uncertainty changes."""
    if carried.geometry is None:
        return (
            "the geometry is taken as exact: the robot comes without a covariance of its geometry (give the folder of "
            "a fit); sigmas are of the torques' noise alone"
        )
    count, p = int(carried.changed.sum()), len(carried.names)
    if count == 0:
        return f"the geometry's uncertainty changes no sigma by more than {100 * NOTHING:g} %: propagation is no matter"
    over = [name for name, yes in zip(carried.names, carried.dominated) if yes]
    more = f"; it exceeds the torque noise's part in {len(over)}: {', '.join(over)}" if over else ""
    rest = f"; in the other {p - count} propagation changes nothing" if count < p else ""
    return f"the geometry's uncertainty raises {count} of {p} sigmas by more than {100 * NOTHING:g} %{more}{rest}"


def _tilt(carried: GeometryUncertainty) -> tuple[str, float]:
    """Return which parameter 1 mrad of tilt of the base against gravity moves most, and by how many σ of torque."""
    size = 1e-3 * _per_sigma(carried)[:, -len(TILTS) :].max(axis=1, initial=0.0)
    worst = int(np.argmax(size))
    return carried.names[worst], float(size[worst])


def _per_sigma(carried: GeometryUncertainty) -> np.ndarray:
    """Return |dφ/dg| in σ of torque noise (p, K + 2); zero where a parameter has no σ."""
    sigma = carried.sigma_torque[:, None]
    return np.divide(np.abs(carried.sensitivity), sigma, out=np.zeros(carried.sensitivity.shape), where=sigma > 0.0)


def _largest(compared: GeometryComparison) -> list[dict[str, Any]]:
    """Return the five parameters that differ most between the geometries, in their total σ, and by how much [%]."""
    size = (compared.values[0] - compared.values[1]) / np.where(compared.sigma[1] > 0.0, compared.sigma[1], np.inf)
    return [
        {
            "name": compared.names[k],
            "sigmas": float(size[k]),
            "percent": float(compared.relative[k]) if np.isfinite(compared.relative[k]) else None,
        }
        for k in np.argsort(-np.abs(size))[:5]
    ]
