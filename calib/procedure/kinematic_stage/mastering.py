"""Joint offsets for a controller's mastering: of a fit of offsets alone, not those of the full geometry.

An offset of the full geometry is right only beside the other parameters. A controller that takes offsets and no other
parameter needs those with which its nominal arm errs least: offsets and placements are fitted to the same rows, and
stored in the fit's folder as `MASTERING`, with their σ and with the error that remains.
"""

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib import files
from calib.errors import CalibError, NotConverged, UsageError
from calib.geometry import installation
from calib.geometry.accuracy import errors
from calib.geometry.fit import fit
from calib.geometry.installation import Installation
from calib.geometry.observation import fixed_parameters, layout, stated_prior
from calib.geometry.weighing import GeometricFit
from calib.procedure.kinematic_stage.fit import Outcome, weighing_settings
from calib.robot import calibrated, description
from calib.robot.calibrated import nominal_of
from calib.robot.tables import vector

MASTERING = "mastering.toml"
NONE_STORED = (
    "offsets of the full geometry would be wrong without the rest of it, and this folder has none of a fit of offsets "
    "alone (frames alone were fitted, its poses do not determine them, or an earlier version made it): fit again, with "
    "--model offsets"
)


class NoOffsets(UsageError):
    """Raised where a folder has no joint offsets of a fit of offsets alone; the message states the reason."""


@dataclass(frozen=True, eq=False)
class Mastering:
    """Joint offsets of a fit of offsets alone.

    Attributes:
        cell: the nominal arm with these offsets, and the placements that belong to them.
        offset: (n,) calibrated minus nominal value of each joint [rad or m].
        sigma: (n,) standard deviation of each offset; zero where it was not fitted.
        rms: error on the fitted rows with these offsets [m]; 0 where neither positions nor distances were measured.
        nominal_rms: the same of the nominal arm.
    """

    cell: Installation
    offset: np.ndarray
    sigma: np.ndarray
    rms: float
    nominal_rms: float

    def __str__(self) -> str:
        if not self.nominal_rms:
            return "of a fit of joint offsets alone"
        return (
            f"of a fit of joint offsets alone: {1e3 * self.rms:.3f} mm rms on the fitted rows "
            f"(nominal {1e3 * self.nominal_rms:.3f} mm)"
        )


def write(folder: Path, outcome: Outcome) -> None:
    """Write `MASTERING` into a fit's folder, unless frames alone were fitted or the rows do not determine offsets."""
    if outcome.selection.chosen == "frames":
        return
    with suppress(CalibError):
        files.write(folder / MASTERING, _content(outcome))


def _content(outcome: Outcome) -> str:
    """Return the content of `MASTERING`: the nominal arm with its offsets, the placements, and the provenance.

    Raises:
        CalibError: the rows do not determine the offsets.
    """
    offsets_fit = _fit(outcome)
    chain = offsets_fit.cell.chain
    variances = np.zeros(len(layout(offsets_fit.cell).names))
    variances[offsets_fit.free] = np.diag(offsets_fit.estimate.covariance)
    ratios = np.array([chain.elements[k].ratio for k in chain.moving])
    provenance = {
        "robot": str(outcome.inputs.source),
        "nominal": outcome.inputs.nominal.values,
        "offset_sigma": np.sqrt(variances[chain.moving]) / np.abs(ratios),
        "rms": errors(offsets_fit.cell, outcome.inputs.fit).rms,
        "nominal_rms": errors(outcome.nominal_cell, outcome.inputs.fit).rms,
    }
    tables = {**installation.frame_tables(offsets_fit.cell), "provenance": provenance}
    return description.content(chain, tables, "the nominal arm with the joint offsets of a fit of offsets alone")


def read(folder: Path) -> Mastering:
    """Return the joint offsets of a fit of offsets alone, from a fit's folder.

    Args:
        folder: the folder.

    Raises:
        NoOffsets: the folder does not contain them.
    """
    path = folder / MASTERING
    if not path.is_file():
        raise NoOffsets(NONE_STORED)
    robot, extra = calibrated.read_whole(path)
    chain, nominal = robot.chain, nominal_of(robot)
    offsets = []
    for k in chain.moving:
        element = chain.elements[k]
        offsets.append((element.value - nominal.elements[k].value) / element.ratio)
    provenance = extra["provenance"]
    sigma = vector(provenance["offset_sigma"], chain.n, f"{path}, provenance.offset_sigma")
    rms, nominal_rms = provenance["rms"], provenance["nominal_rms"]
    return Mastering(installation.read(path), np.array(offsets), sigma, rms, nominal_rms)


def _fit(outcome: Outcome) -> GeometricFit:
    """Return the fit of joint offsets and placements to the fitted rows, from the nominal arm."""
    cell = outcome.nominal_cell
    if outcome.selection.chosen == "offsets" and cell is outcome.selection.nominal.cell:
        return outcome.selection.fit
    options = outcome.options
    candidates = np.concatenate([cell.chain.driven, layout(cell).frame_index])
    free = np.setdiff1d(candidates, fixed_parameters(cell, options))
    settings = weighing_settings(options, outcome.settings)
    result = fit(cell, outcome.inputs.fit, free, settings=settings, prior=stated_prior(cell, options))
    if not result.solution.status.good:
        raise NotConverged(f"the fit of joint offsets alone did not converge: {result.solution.status.value}")
    return result
