"""Effect of a calibrated geometry's uncertainty on the torques that are predicted for a designed motion."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calib.data import csv_table
from calib.dynamics.base import places
from calib.dynamics.load_cases import LoadCases
from calib.procedure.dynamic_stage.geometry_tables import SENSITIVITY, TORQUE_COVARIANCE
from calib.procedure.excitation.excited_model import ExcitedModel, moved_to
from calib.robot import calibrated
from calib.robot.calibrated import CalibratedChain
from calib.robot.chain import Chain


@dataclass(frozen=True, eq=False)
class GeometrySpread:
    """Principal errors g_i of a geometry, and the models with the geometry changed by them.

    `calib.procedure.excitation.prior_motions.PrincipalErrors` explains principal errors.

    Attributes:
        moved: r pairs of models, with the geometry changed by +g_i and by -g_i.
        before: (b, r) shifts S g_i of the base parameters of an earlier identification, with S their sensitivity to the
            geometry; zero without an earlier identification.
    """

    moved: tuple[tuple[LoadCases, LoadCases], ...]
    before: np.ndarray

    def felt(self, values: np.ndarray, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the changes (N, rows, r) of the torques [N m or N] by each of r principal errors.

        The base parameters are constant.

        Args:
            values: (b,) base parameters.
            q, v, a: (N, n) positions, velocities and accelerations.
        """
        changes = []
        for up, down in self.moved:
            change = up.regressor(q, v, a) - down.regressor(q, v, a)
            changes.append(change @ values / 2.0)
        return np.stack(changes, axis=2)


def geometry_spread(
    robot: object, source: Path, chain: Chain, model: ExcitedModel, after: Path | None
) -> GeometrySpread | None:
    """Return the principal errors of a geometry, and their effect on the parameters of an earlier identification.

    None if the covariance of the geometry, or the values of the parameters, are unknown.

    Args:
        robot, source: robot as given by the caller, and its file.
        chain: arm for which the motion is designed.
        model: model that predicts the torques.
        after: folder of an identification, from which the covariance of the geometry is taken; None: from the robot.
    """
    stored = None if after is None else after / SENSITIVITY
    path = source if after is None else after / calibrated.ROBOT
    exact = model.exact
    values = model.values
    covariance = None
    if after is None and isinstance(robot, CalibratedChain):
        covariance = robot.covariance
    elif path.suffix == ".toml":
        covariance = calibrated.read(path).covariance
    if covariance is None or values is None:
        return None
    if after is not None:
        is_complete = (after / SENSITIVITY).is_file() and (after / TORQUE_COVARIANCE).is_file()
        # an earlier version's
        if not is_complete:
            return None
    sizes, axes = np.linalg.eigh(covariance)
    errors = (axes * np.sqrt(np.maximum(sizes, 0.0)))[:, sizes > 1e-12 * sizes[-1]]

    def moved(step: np.ndarray) -> LoadCases:
        moved_chain = chain.with_values(np.asarray(chain.values) + step)
        return replace(exact, model=moved_to(moved_chain, exact.model))

    before = np.zeros((len(exact.names), errors.shape[1]))
    if stored is not None:
        # an element each, then two tilts
        names, *columns = csv_table.read_table(stored).cells
        index = places(exact.names, names.tolist(), exact.model.names)
        if index is None:
            return None
        before = (np.column_stack(columns[: len(errors)]) @ errors)[index]
    pairs = tuple((moved(error), moved(-error)) for error in errors.T)
    return GeometrySpread(pairs, before)
