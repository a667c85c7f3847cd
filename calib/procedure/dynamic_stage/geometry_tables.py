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
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from calib import files
from calib.data.csv_table import read_table
from calib.folders import write_covariance
from calib.identification import model_file
from calib.identification.prediction import Dynamics
from calib.identification.uncertainty.geometry_uncertainty import (
    NOTHING,
    TILTS,
    GeometryComparison,
    GeometryUncertainty,
)
from calib.procedure.dynamic_stage.identify import IdentificationOutcome
from calib.records import Number
from calib.robot import calibrated

# a shift, in σ_torque, that raises a σ by more than `NOTHING`
MIN_SHIFT = float(np.sqrt((1.0 + NOTHING) ** 2 - 1.0))
# changes between the geometries that metrics.json lists
MAX_CHANGES = 5

EFFECTS, SENSITIVITY, GEOMETRIES = "geometry_effects.csv", "sensitivity.csv", "geometries.csv"
TORQUE_COVARIANCE = "covariance_torque.csv"


@dataclass(frozen=True)
class TiltEffect:
    """Parameter that changes most if the base is tilted by 1 mrad.

    Attributes:
        parameter: name of the parameter.
        sigmas: its change, divided by its standard deviation from torque noise.
    """

    parameter: str
    sigmas: float


@dataclass(frozen=True)
class CalibrationChange:
    """Difference of a parameter between the estimates on the nominal and on the calibrated geometry.

    Attributes:
        name: name of the parameter.
        sigmas: nominal minus calibrated estimate, divided by the parameter's total σ.
        percent: nominal minus calibrated estimate, in percent of the calibrated one.
    """

    name: str
    sigmas: float
    percent: Number


@dataclass(frozen=True)
class GeometryMetrics:
    """Effect of the geometry's uncertainty on the estimate: the entry ``geometry`` of ``metrics.json``.

    Attributes:
        propagated: whether the robot has a covariance of its geometry, which was propagated to the estimate.
        summary: the effect in one sentence.
        changed: names of the parameters whose σ the geometry's uncertainty raises.
        geometry_exceeds_torque: names of the parameters whose σ from the geometry exceeds the σ from torque noise.
        moved_by_1_mrad_of_tilt: parameter that changes most if the base is tilted by 1 mrad.
        largest_growth_of_sigma: largest ratio of total σ to σ from torque noise, over all parameters.
        largest_changes_from_nominal: the five largest changes from the nominal to the calibrated geometry.
    """

    propagated: bool
    summary: str
    changed: tuple[str, ...]
    moved_by_1_mrad_of_tilt: TiltEffect
    geometry_exceeds_torque: tuple[str, ...] = ()
    largest_growth_of_sigma: float = 1.0
    largest_changes_from_nominal: tuple[CalibrationChange, ...] = ()


class TwoGeometries(NamedTuple):
    """A row of ``geometries.csv``: a parameter identified on the nominal and on the calibrated geometry.

    Attributes:
        name, unit: name and unit of the parameter.
        nominal, sigma_nominal: estimate on the nominal geometry, and its σ from torque noise.
        calibrated, sigma_calibrated: estimate on the calibrated geometry, and its total σ.
        relative_percent: nominal minus calibrated estimate, in percent of the calibrated one; NaN if that is zero.
        sigma_difference: standard deviation of the difference.
        essential: ``yes`` for essential parameters, otherwise ``no``.
    """

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
    """A row of ``geometry_effects.csv``: the effect of a geometric element's uncertainty on the dynamic parameters.

    Attributes:
        rank: rank of the element by `shift_sigma`, from 1.
        element, unit: name and unit (m or rad) of the element.
        sigma: σ of the element; not finite, or None in the file, if it was not fitted.
        matters: ``yes`` if the element alone raises the σ of some parameter by more than 1 %, else ``no``; empty
            without σ.
        parameter: name of the parameter that the element shifts most; empty if it shifts none.
        shift_sigma: shift of this parameter if the element changes by one σ, divided by the parameter's σ from torque
            noise.
        parameters_moved: number of parameters whose σ the element alone raises by more than 1 %; None without σ.
        torque_rms: rms change of the rigid-body torque if the element changes by one σ, at constant parameters [N m or
            N].
        torque_rms_left: the same after the parameters have been estimated again [N m or N].
        shift_sigma_per_milli: shift as `shift_sigma`, for a change of the element by 1 mm or 1 mrad.
    """

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
    """Write the tables of sensitivities, of ranked geometric effects, and of the estimates on both geometries.

    Nothing is written if the effect of the geometry was not computed.

    Args:
        outcome: the identification; its effect of the geometry may be None.
        folder: folder to write into.
    """
    carried = outcome.carried
    if carried is None:
        return
    header = [f"{name} [{unit}]" for name, unit in zip(carried.elements, carried.units)]
    rows = [[name, *row] for name, row in zip(carried.names, carried.sensitivity)]
    files.write_table(folder / SENSITIVITY, ("name", *header), rows)
    files.write_table(folder / EFFECTS, GeometricEffect._fields, effects(carried))
    write_covariance(folder / TORQUE_COVARIANCE, carried.names, carried.torque)
    if outcome.geometries is not None:
        table = _geometries(outcome.geometries, _essential_names(outcome))
        files.write_table(folder / GEOMETRIES, TwoGeometries._fields, table)


def on_nominal_geometry(folder: Path) -> Dynamics | None:
    """Return the model on the nominal (CAD) geometry that was identified beside the model in a folder.

    None where there is no such estimate, as for a robot whose geometry was not calibrated.
    """
    table = folder / GEOMETRIES
    if not table.is_file():
        return None
    nominal = calibrated.read(folder / calibrated.ROBOT).nominal
    if nominal is None:
        return None
    dynamics = model_file.from_table(nominal, model_file.read_table(folder))
    columns = {name: column for column, name in enumerate(dynamics.model.names)}
    values = dynamics.values.copy()
    estimates = read_table(table)
    for name, value in zip(estimates.texts("name"), estimates.numbers("nominal", None)):
        column = columns[name] if name in columns else columns[name.removesuffix("R")]
        values[column] = value
    return replace(dynamics, values=values)


def _ranking(carried: GeometryUncertainty) -> np.ndarray:
    """Return the indices of the geometric elements, sorted by the largest parameter shift that one σ causes.

    Elements without σ are last. Shifts that are equal but for rounding keep the order of the chain.

    Args:
        carried: effect of the geometry's uncertainty on the parameters.
    """
    has_sigma = np.isfinite(carried.deviations)
    shift_per_unit = _per_sigma(carried).max(axis=0, initial=0.0)
    deviations = np.where(has_sigma, carried.deviations, 0.0)
    size = np.where(has_sigma, shift_per_unit * deviations, shift_per_unit)
    with np.errstate(divide="ignore"):
        magnitude = np.round(np.log(size), 6)
    return np.lexsort((-magnitude, ~has_sigma))


def effects(carried: GeometryUncertainty) -> list[GeometricEffect]:
    """Return the rows of ``geometry_effects.csv``, sorted by the shift that one σ of the element causes, largest first.

    `shift_sigma` is the shift of the most affected parameter if the element changes by one σ, in units of that
    parameter's σ from torque noise; `shift_sigma_per_milli` is the shift if the element changes by 1 mm or 1 mrad.
    `torque_rms` is the rms change of the rigid-body torque by one σ at constant parameters; `torque_rms_left` is the
    change that remains after the parameters have been estimated again. `matters` is ``yes`` if the element alone raises
    the σ of some parameter by more than 1 %; it is empty for elements without σ.

    Args:
        carried: effect of the geometry's uncertainty on the parameters.
    """
    rows = []
    shifts_per_unit = _per_sigma(carried)
    for rank, k in enumerate(_ranking(carried), start=1):
        per_unit, sigma = shifts_per_unit[:, k], carried.deviations[k]
        shifts = per_unit * sigma
        worst = int(np.argmax(per_unit))
        matters, count = "", None
        if np.isfinite(sigma):
            matters = "yes" if shifts.max() > MIN_SHIFT else "no"
            count = int((shifts > MIN_SHIFT).sum())
        rows.append(
            GeometricEffect(
                rank=rank,
                element=carried.elements[k],
                unit=carried.units[k],
                sigma=float(sigma),
                matters=matters,
                parameter=carried.names[worst] if per_unit[worst] > 0.0 else "",
                shift_sigma=shifts[worst],
                parameters_moved=count,
                torque_rms=float(carried.felt[k] * sigma),
                torque_rms_left=float(carried.left[k] * sigma),
                shift_sigma_per_milli=1e-3 * per_unit[worst],
            )
        )
    return rows


def _geometries(comparison: GeometryComparison, essential: Sequence[str]) -> Iterator[TwoGeometries]:
    """Yield the rows of ``geometries.csv``: each parameter identified on the nominal and on the calibrated geometry.

    Args:
        comparison: estimates on the nominal and on the calibrated geometry.
        essential: names of the essential parameters, which are marked.
    """
    nominal, calibrated = comparison.values
    sigma_nominal, sigma_calibrated = comparison.sigma
    relative = np.where(np.isfinite(comparison.relative), comparison.relative, np.nan)
    for k, (name, unit) in enumerate(zip(comparison.names, comparison.units)):
        yield TwoGeometries(
            name=name,
            unit=unit,
            nominal=nominal[k],
            sigma_nominal=sigma_nominal[k],
            calibrated=calibrated[k],
            sigma_calibrated=sigma_calibrated[k],
            relative_percent=relative[k],
            sigma_difference=comparison.difference[k],
            essential="yes" if name in essential else "no",
        )


def _essential_names(outcome: IdentificationOutcome) -> tuple[str, ...]:
    """Return the names of the essential parameters; if no parameters were eliminated, all names.

    Args:
        outcome: the identification.
    """
    identification = outcome.found
    if identification.elimination is None:
        return identification.names
    elimination = identification.elimination
    printed = dict(zip(elimination.base.estimate.names, identification.names))
    return tuple(printed[name] for name in elimination.essential.estimate.names)


def metrics(carried: GeometryUncertainty, comparison: GeometryComparison | None) -> GeometryMetrics:
    """Return the metrics on the geometry's uncertainty.

    Args:
        carried: effect of the geometry's uncertainty on the parameters.
        comparison: estimates on the nominal and on the calibrated geometry; None: there is only one geometry.
    """
    growth = carried.sigma / np.where(carried.sigma_torque > 0.0, carried.sigma_torque, 1.0)
    return GeometryMetrics(
        propagated=carried.geometry is not None,
        summary=summary(carried),
        changed=_marked(carried.names, carried.changed),
        moved_by_1_mrad_of_tilt=_tilt(carried),
        geometry_exceeds_torque=_marked(carried.names, carried.dominated),
        largest_growth_of_sigma=float(growth.max(initial=1.0)),
        largest_changes_from_nominal=() if comparison is None else _largest(comparison),
    )


def _marked(names: Sequence[str], mask: np.ndarray) -> tuple[str, ...]:
    """Return the names, out of p names, at which a mask (p,) is true."""
    return tuple(name for name, marked in zip(names, mask) if marked)


def summary(carried: GeometryUncertainty) -> str:
    """Return a sentence for the user on the effect of the geometry's uncertainty on the parameters' σ.

    Args:
        carried: effect of the geometry's uncertainty on the parameters.
    """
    if carried.geometry is None:
        return (
            "the geometry is assumed exact, sigmas contain torque noise only: the robot has no covariance of its "
            "geometry (give the folder of a fit)"
        )
    count, p = int(carried.changed.sum()), len(carried.names)
    limit = f"{100 * NOTHING:g} %"
    if count == 0:
        return f"the geometry's uncertainty changes no sigma by more than {limit}: no propagation needed"
    sentence = f"the geometry's uncertainty raises {count} of {p} sigmas by more than {limit}"
    if count < p:
        sentence += f" and leaves {p - count} unchanged"
    dominated = _marked(carried.names, carried.dominated)
    if dominated:
        sentence += f"; for {len(dominated)} the geometry contributes more than torque noise: {', '.join(dominated)}"
    return sentence


def _tilt(carried: GeometryUncertainty) -> TiltEffect:
    """Return the parameter that changes most if the base is tilted by 1 mrad, and its change.

    The change is in multiples of the parameter's σ from torque noise.

    Args:
        carried: effect of the geometry's uncertainty on the parameters.
    """
    size = 1e-3 * _per_sigma(carried)[:, -len(TILTS) :].max(axis=1, initial=0.0)
    worst = int(np.argmax(size))
    return TiltEffect(carried.names[worst], float(size[worst]))


def _per_sigma(carried: GeometryUncertainty) -> np.ndarray:
    """Return |sensitivity| of the parameters to geometric elements and base tilts, in multiples of σ from torque noise.

    The shape is (p, K + 2) for p parameters, K geometric elements and 2 tilts. The entries of a parameter without σ are
    zero.

    Args:
        carried: effect of the geometry's uncertainty on the parameters.
    """
    sigma = carried.sigma_torque[:, None]
    return np.divide(np.abs(carried.sensitivity), sigma, out=np.zeros(carried.sensitivity.shape), where=sigma > 0.0)


def _largest(comparison: GeometryComparison) -> tuple[CalibrationChange, ...]:
    """Return the five parameters with the largest changes between the geometries, in total σ and in percent.

    Args:
        comparison: estimates on the nominal and on the calibrated geometry.
    """
    nominal, calibrated = comparison.values
    _, sigma = comparison.sigma
    size = (nominal - calibrated) / np.where(sigma > 0.0, sigma, np.inf)
    names, relative = comparison.names, comparison.relative
    largest = np.argsort(-np.abs(size))[:MAX_CHANGES]
    return tuple(CalibrationChange(names[k], float(size[k]), float(relative[k])) for k in largest)
