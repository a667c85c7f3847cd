"""A load that nobody stated, in a file without torques: it explains the errors of a fit with compliance by torques."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from calib.data.poses.measurements import PoseMeasurements, Positions
from calib.errors import Finding, finding
from calib.geometry.installation import Installation
from calib.geometry.model_choice.cross_validation import project_out
from calib.geometry.observation import layout, observe, prepare
from calib.geometry.static_torques.gravity_fit import carried_load
from calib.geometry.static_torques.load_errors import SAME_LOAD

# smallest number of rows, rms with the load as a share of that without, and sigmas of the load's mass (our choice)
MIN_ROWS, BETTER, MIN_SIGMAS = 15, 0.8, 6.0


def suspected_load(cell: Installation, block: PoseMeasurements) -> Finding | None:
    """Return a finding if a mass at the tip explains the errors of rows of which neither torque nor load is known.

    The mass is fitted by least squares, with base and tool placed anew: where they stood otherwise is no load.

    Args:
        cell: the calibrated arm with base and tool placement.
        block: rows that were not fitted.
    """
    silent = block.measured_torque is None and block.payload is None
    if not silent or not isinstance(block, Positions) or len(block) < MIN_ROWS or not cell.deflection.by_torque:
        return None
    reference = cell.deflection.reference
    if reference is None or reference.inertias is None:
        return None
    block = replace(block, torque=None, load=None)
    one_kilogram = carried_load(cell.chain, np.array([[1.0, 0.0, 0.0, 0.0]]))[0]
    frames = layout(cell).index("station", "tool")
    residual, jacobian = _positions(cell, block, frames)
    loaded = replace(cell, deflection=cell.deflection.carrying(one_kilogram))
    shift = residual - _positions(loaded, block, frames)[0]
    stacked = np.concatenate([jacobian, shift[None], residual[None]])
    shift, residual = project_out(stacked, np.arange(len(frames)))[-2:].reshape(2, -1)
    information = float(shift @ shift)
    if information <= 0.0:
        return None
    mass = float(shift @ residual) / information
    remaining = residual - mass * shift
    before = float(np.sqrt(np.sum(residual**2) / len(block)))
    after = float(np.sqrt(np.sum(remaining**2) / len(block)))
    sigma = float(np.sqrt(np.mean(remaining**2) / information))
    if after > BETTER * before or mass < max(MIN_SIGMAS * sigma, SAME_LOAD):
        return None
    name = Path(block.file).name
    return finding("load-suspected", file=name, mass=mass, sigma=sigma, before=before, after=after)


def _positions(cell: Installation, block: Positions, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the residuals (3, m) [m] of a block's positions, and their derivatives (f, 3, m) by parameters (f,)."""
    for part in observe(cell, prepare(cell, [block])[0], columns):
        if part.label == "position":
            return part.value, part.jacobian
    raise AssertionError("positions have a part of this label")
