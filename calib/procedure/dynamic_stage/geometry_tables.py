"""Effect of the geometry's uncertainty on an identification, as tables, metrics and text.

Files in addition to those of every identification (``calib identify --out``)::

    estimate.csv          sigma and rsd are totals; sigma_torque is the part of the torques' noise, sigma_geometry that
                          of the geometry, empty where the robot came without a covariance (no folder of a fit)
    covariance.csv        total: Sigma_torque + S Sigma_geometry S'; covariance_torque.csv is Sigma_torque
    sensitivity.csv       S: change of each parameter per m or rad of each element of the chain, and per rad of tilt of
                          gravity about the base's x and y axes (gravity.rx, gravity.ry)
    geometry_effects.csv  the elements ranked by what one sigma of theirs does: the parameter that moves most, by how
                          many of its sigma_torque, and the rms of the torque before and after re-estimation; without a
                          sigma: not fitted (a choice of frames, or not told by the poses), effect of 1 mm or 1 mrad
    geometries.csv        each parameter on the nominal and on the calibrated geometry, from the same torques
    chain_covariance.csv  that of the fit, for whoever goes on from this folder
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from calib import files
from calib.folders import write_covariance
from calib.identification.uncertainty.geometry_uncertainty import (
    NOTHING,
    TILTS,
    GeometryComparison,
    GeometryUncertainty,
)
from calib.procedure.dynamic_stage.identify import IdentificationOutcome
from calib.records import Number

EFFECTS, SENSITIVITY, GEOMETRIES = "geometry_effects.csv", "sensitivity.csv", "geometries.csv"
TORQUE_COVARIANCE = "covariance_torque.csv"
MIN_SHIFT = float(np.sqrt((1.0 + NOTHING) ** 2 - 1.0))  # a shift, in σ_torque, that raises a σ by more than `NOTHING`


@dataclass(frozen=True)
class TiltEffect:
    """Parameter that a base tilt of 1 mrad changes most, and the change, in sigmas from torque noise."""

    parameter: str
    sigmas: float


@dataclass(frozen=True)
class ParameterChange:
    """Change of a parameter from the nominal to the calibrated geometry, in its total σ and in percent."""

    name: str
    sigmas: float
    percent: Number


@dataclass(frozen=True)
class GeometryMetrics:
    """Effect of the geometry's uncertainty on the estimate: the entry ``geometry`` of ``metrics.json``.

    Attributes:
        propagated: whether the robot came with a covariance of its geometry.
        summary: in a sentence.
        changed, geometry_exceeds_torque: parameters whose σ it raises, and those where it exceeds the torques' part.
        moved_by_1_mrad_of_tilt: what else a tilt of the base would move.
        largest_growth_of_sigma: of any parameter, as a factor.
        largest_changes_from_nominal: the five largest.
    """

    propagated: bool
    summary: str
    changed: tuple[str, ...]
    moved_by_1_mrad_of_tilt: TiltEffect
    geometry_exceeds_torque: tuple[str, ...] = ()
    largest_growth_of_sigma: float = 1.0
    largest_changes_from_nominal: tuple[ParameterChange, ...] = ()


class TwoGeometries(NamedTuple):
    """A row of ``geometries.csv``: a parameter identified on the nominal and on the calibrated geometry."""

    name: str
    unit: str
    nominal: float
    sigma_nominal: float
    calibrated: float
    sigma_calibrated: float
    relative_percent: float | None
    sigma_difference: float
    essential: str


class GeometricEffect(NamedTuple):
    """A row of ``geometry_effects.csv``: the effect of one sigma of a geometric element on the dynamics."""

    rank: int
    element: str
    unit: str
    sigma: float | None
    matters: str
    parameter: str
    shift_sigma: float | None
    parameters_moved: int | None
    torque_rms: float | None
    torque_rms_left: float | None
    shift_sigma_per_milli: float


def write(outcome: IdentificationOutcome, folder: Path) -> None:
    """Write the tables of sensitivities, of ranked effects, and of the estimates on both geometries."""
    carried = outcome.carried
    if carried is None:
        return
    rows = ([name, *row] for name, row in zip(carried.names, carried.sensitivity))
    header = [f"{name} [{unit}]" for name, unit in zip(carried.elements, carried.units)]
    files.write_table(folder / SENSITIVITY, ("name", *header), rows)
    files.write_table(folder / EFFECTS, GeometricEffect._fields, effects(carried))
    write_covariance(folder / TORQUE_COVARIANCE, carried.names, carried.torque)
    if outcome.geometries is not None:
        table = _geometries(outcome.geometries, _essential_names(outcome))
        files.write_table(folder / GEOMETRIES, TwoGeometries._fields, table)


def _ranking(carried: GeometryUncertainty) -> np.ndarray:
    """Return the elements' indices, sorted by the largest shift that one σ causes; elements without σ last."""
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
        per_unit, sigma = units[:, k], carried.deviations[k]
        worst, shifts = int(np.argmax(per_unit)), per_unit * sigma
        known = bool(np.isfinite(sigma))
        found.append(
            GeometricEffect(
                rank,
                carried.elements[k],
                carried.units[k],
                float(sigma),
                ("yes" if shifts.max() > MIN_SHIFT else "no") if known else "",
                carried.names[worst] if per_unit[worst] > 0.0 else "",
                shifts[worst],
                int((shifts > MIN_SHIFT).sum()) if known else None,
                float(carried.felt[k] * sigma),
                float(carried.left[k] * sigma),
                1e-3 * per_unit[worst],
            )
        )
    return found


def _geometries(found: GeometryComparison, essential: Sequence[str]) -> Iterator[TwoGeometries]:
    """Yield the rows of ``geometries.csv``: each parameter on the nominal and on the calibrated geometry."""
    (nominal, calibrated), (s_nominal, s_calibrated) = found.values, found.sigma
    relative = np.where(np.isfinite(found.relative), found.relative, np.nan)
    kept = ("yes" if name in essential else "no" for name in found.names)
    columns = nominal, s_nominal, calibrated, s_calibrated, relative, found.difference, kept
    return (TwoGeometries(*row) for row in zip(found.names, found.units, *columns))


def _essential_names(outcome: IdentificationOutcome) -> tuple[str, ...]:
    """Return the names of the essential parameters; all names if none were removed."""
    found = outcome.found
    if found.elimination is None:
        return found.names
    own = dict(zip(found.elimination.base.estimate.names, found.names))
    return tuple(own[name] for name in found.elimination.essential.estimate.names)


def metrics(carried: GeometryUncertainty, compared: GeometryComparison | None) -> GeometryMetrics:
    """Return the metrics of the geometry's uncertainty in the estimate."""
    growth = carried.sigma / np.where(carried.sigma_torque > 0.0, carried.sigma_torque, 1.0)
    return GeometryMetrics(
        carried.geometry is not None,
        summary(carried),
        tuple(name for name, yes in zip(carried.names, carried.changed) if yes),
        _tilt(carried),
        tuple(name for name, yes in zip(carried.names, carried.dominated) if yes),
        float(growth.max(initial=1.0)),
        () if compared is None else _largest(compared),
    )


def summary(carried: GeometryUncertainty) -> str:
    """Return a sentence on the effect of the geometry's uncertainty."""
    if carried.geometry is None:
        return (
            "the geometry is assumed exact, sigmas contain torque noise only: the robot has no covariance of its "
            "geometry (give the folder of a fit)"
        )
    count, p = int(carried.changed.sum()), len(carried.names)
    if count == 0:
        return f"the geometry's uncertainty changes no sigma by more than {100 * NOTHING:g} %: no propagation needed"
    over = [name for name, yes in zip(carried.names, carried.dominated) if yes]
    more = f"; for {len(over)} it contributes more than torque noise: {', '.join(over)}" if over else ""
    rest = f" and leaves {p - count} unchanged" if count < p else ""
    return f"the geometry's uncertainty raises {count} of {p} sigmas by more than {100 * NOTHING:g} %{rest}{more}"


def _tilt(carried: GeometryUncertainty) -> TiltEffect:
    """Return the parameter that 1 mrad of base tilt against gravity changes most, and its change in σ of torque."""
    size = 1e-3 * _per_sigma(carried)[:, -len(TILTS) :].max(axis=1, initial=0.0)
    worst = int(np.argmax(size))
    return TiltEffect(carried.names[worst], float(size[worst]))


def _per_sigma(carried: GeometryUncertainty) -> np.ndarray:
    """Return the sensitivities |dφ/dg| in σ of torque noise (p, K + 2); zero if a parameter has no σ."""
    sigma = carried.sigma_torque[:, None]
    return np.divide(np.abs(carried.sensitivity), sigma, out=np.zeros(carried.sensitivity.shape), where=sigma > 0.0)


def _largest(compared: GeometryComparison) -> tuple[ParameterChange, ...]:
    """Return the five parameters that differ most between the geometries, with the differences in total σ and [%]."""
    size = (compared.values[0] - compared.values[1]) / np.where(compared.sigma[1] > 0.0, compared.sigma[1], np.inf)
    worst = np.argsort(-np.abs(size))[:5]
    return tuple(ParameterChange(compared.names[k], float(size[k]), float(compared.relative[k])) for k in worst)
