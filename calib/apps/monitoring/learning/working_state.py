"""State of an update in the model's folder: information filters, the first model, and the logs learnt from."""

from __future__ import annotations

import io
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calib import files, folders
from calib.config_types import ParsedTable
from calib.errors import RobotError, UsageError, refuse_option, refused_as, require
from calib.records import read_json
from calib.toolkit.chains import CalibratedChain, read_calibrated
from calib.toolkit.model_identification import DriftBank, WorkingModel, from_table
from calib.toolkit.recordings import SKETCH, Fingerprint
from calib.toolkit.result_folders import IdentificationFolder
from calib.toolkit.torque_models import estimated_columns, read_model_table

STATE = "learning.npz"
LOGS = "learning.json"
# arrays of a `DriftBank`, under their names in the file
BANK = ("group", "size", "rates", "factors", "log_ratio")
# torque rows of which each belongs to one joint
ROWS_SUPPORTED = ("motor", "link", "both")


@dataclass(frozen=True)
class LogRecord:
    """What was learnt from one log.

    Attributes:
        name, date, day: name and date of the log, see `calib.apps.monitoring.learning.logs.DatedLog`.
        seconds: its duration [s].
        error, first_error: torque that the model before this log, and the first model, leave unexplained [%].
        ratio: largest ratio of a joint's errors to the predicted ones, rms.
        cause: cause of errors that are not as predicted, a value of `Cause`.
        learnt: whether the log was learnt from.
        sigma: largest torque that one σ of a parameter moves after the log [% of the torque].
        parameters: (p,) parameters that drift, after the log: friction, then gains as factors.
        sigmas: (p,) their standard deviations.
    """

    name: str
    date: str
    day: float
    seconds: float
    error: float
    first_error: float
    ratio: float
    cause: str
    learnt: bool
    sigma: float
    parameters: tuple[float, ...]
    sigmas: tuple[float, ...]


@dataclass(frozen=True)
class LearningRecord:
    """Content of ``learning.json``.

    Attributes:
        first: model table of the first identification.
        names, units: names and units of the parameters: estimated ones, then gains.
        values: values of the estimated ones in the first identification.
        logs: the logs, in the order of their dates.
    """

    first: ParsedTable
    names: tuple[str, ...]
    units: tuple[str, ...]
    values: tuple[float, ...]
    logs: tuple[LogRecord, ...] = ()


@dataclass(frozen=True, eq=False)
class WorkingState:
    """A model that further logs update.

    Attributes:
        folder: folder from which it was read.
        robot: the arm with whose geometry the model was identified.
        model: the model of the first identification.
        bank: information filters, at the date of the last log.
        record: first model and logs.
        sketches: (logs, 64) sketches of the logs that were learnt from.
        unit: unit of the torques.
        identified_from: the recordings of the first identification.
    """

    folder: Path
    robot: CalibratedChain
    model: WorkingModel
    bank: DriftBank
    record: LearningRecord
    sketches: np.ndarray
    unit: str
    identified_from: tuple[Fingerprint, ...] = ()

    @property
    def drifting(self) -> np.ndarray:
        """Indices of the parameters that drift."""
        return np.flatnonzero(self.bank.group >= 0)

    @property
    def last_day(self) -> float | None:
        """Date of the last log; None before any log."""
        if not self.record.logs:
            return None
        return self.record.logs[-1].day

    def after(self, log: LogRecord, bank: DriftBank, sketch: np.ndarray) -> WorkingState:
        """Return the state after a log."""
        record = replace(self.record, logs=(*self.record.logs, log))
        sketches = self.sketches
        if log.learnt:
            sketches = np.vstack([self.sketches, sketch])
        return replace(self, bank=bank, record=record, sketches=sketches)

    def write(self, folder: Path) -> None:
        """Write the state into a folder."""
        content = io.BytesIO()
        arrays = {name: getattr(self.bank, name) for name in BANK}
        counts = np.array([self.bank.count, self.bank.prior_count])
        np.savez(content, counts=counts, sketches=self.sketches, **arrays)
        files.write(folder / STATE, content.getvalue())
        files.write_json(folder / LOGS, self.record)


def read_state(path: str | Path) -> WorkingState:
    """Return the state of an update from the folder of an identification, or of an earlier update.

    Raises:
        UsageError: for a parallel robot, or torques that are not those of single joints.
        RobotError: if the folder contains no identification, or one of a version without its torque errors.
    """
    folder = Path(path)
    table = read_model_table(folder)
    kind = table.get("kind", "motor")
    if kind not in ROWS_SUPPORTED:
        refuse_option(folder, f"has rows '{kind}'; an update needs {', '.join(ROWS_SUPPORTED)}: identify with those")
    if "gravity" not in table or "bodies" not in table:
        refuse_option(folder, "is not of a serial arm, which calib update needs: identify it from all logs together")
    robot = read_calibrated(folder)
    identification = IdentificationFolder(folder)
    metrics = identification.metrics()
    recordings = identification.identified_from()
    if metrics.error_density is None or metrics.findings is None:
        raise RobotError(f"{folder}/metrics.json has no error_density of the torque rows; identify again")
    names, covariance = folders.read_covariance(folder)
    variances = np.diag(covariance)
    estimated = [k for k, name in enumerate(names) if variances[k] > 0.0 and name not in metrics.switched_off]
    record = _read_record(folder)
    first_table = table if record is None else record.first
    message = f"{folder}: dynamics.json and covariance.csv do not match: {{}}; identify again"
    with refused_as(RobotError, (KeyError, TypeError, ValueError, IndexError), message):
        dynamics = from_table(robot.chain, first_table)
        columns = estimated_columns(dynamics, [names[k] for k in estimated])
    rows = dynamics.model.torque_rows.titles(robot.chain.joint_names)
    estimated_names = [names[k] for k in estimated]
    units = dict(zip(dynamics.model.names, dynamics.model.units))
    model = WorkingModel(
        dynamics=dynamics,
        names=(*estimated_names, *(f"gain of {row}" for row in rows)),
        units=(*(units[dynamics.model.names[k]] for k in columns), *[""] * len(rows)),
        columns=columns,
        values=dynamics.values[columns],
        density=metrics.error_density,
        discrepancy=metrics.findings.errors,
        row_names=tuple(rows),
    )
    unit = table.get("unit", "N m")
    if record is not None:
        bank, sketches = _read_bank(folder, len(model.names))
        return WorkingState(folder, robot, model, bank, record, sketches, unit, recordings)
    bank = model.first_state(covariance[np.ix_(estimated, estimated)])
    record = LearningRecord(table, model.names, model.units, tuple(model.values.tolist()))
    sketches = np.zeros((0, SKETCH), np.uint64)
    return WorkingState(folder, robot, model, bank, record, sketches, unit, recordings)


def _read_record(folder: Path) -> LearningRecord | None:
    """Return the record of earlier updates in a folder; None if there was none."""
    if not (folder / LOGS).is_file():
        return None
    return read_json(folder / LOGS, "update again", LearningRecord)


def _read_bank(folder: Path, parameters: int) -> tuple[DriftBank, np.ndarray]:
    """Return the information filters and the sketches of logs from a folder.

    Args:
        folder: folder of an earlier update.
        parameters: number of parameters that they must have.
    """
    message = f"{folder}/{STATE} is damaged or of another version ({{}}); update the first identification again"
    with refused_as(UsageError, (OSError, KeyError, ValueError), message):
        with np.load(folder / STATE) as content:
            arrays = {name: content[name] for name in BANK}
            count, prior_count = content["counts"].tolist()
            sketches = content["sketches"]
        bank = DriftBank(**arrays, count=count, prior_count=prior_count)
        require(bank.parameters == parameters, f"{bank.parameters} parameters instead of {parameters}", ValueError)
    return bank, sketches
