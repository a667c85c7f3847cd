"""Result folder of an identification: written completely into a temporary folder, then moved to its final path."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from calib import files, folders
from calib.data.csv_table import read_table
from calib.data.signals.fingerprint import Fingerprint, Fingerprints, common_share
from calib.dynamics.base import expressions
from calib.errors import UsageError, refuse_option, refused_as, require
from calib.identification.checks.joint_compliance import JointCompliance, encoder_difference
from calib.identification.earlier import EarlierChoice
from calib.identification.gains import GainRecord
from calib.identification.identify import Identification
from calib.identification.model_file import MODEL, read_dynamics, refuse_currents, refuse_other_arm, to_table
from calib.identification.physical_consistency import information
from calib.identification.prediction import Dynamics, Score, predict
from calib.identification.registry import method_named
from calib.identification.rows import Case
from calib.identification.uncertainty.torque_errors import TorqueErrorModel, read_uncertainty
from calib.procedure.dynamic_stage import geometry_tables, with_geometry
from calib.procedure.dynamic_stage.identify import (
    DynamicsAssessment,
    IdentificationOutcome,
    ModelFindings,
    RecordingErrors,
)
from calib.procedure.dynamic_stage.inputs import IdentificationInputs
from calib.procedure.dynamic_stage.metrics import ModelMetrics, UnseenReport, metrics, on_bounds, with_current_keys
from calib.procedure.dynamic_stage.verdict import Resting
from calib.procedure.robot_kinds import Mechanism
from calib.records import plain, read_json
from calib.robot import calibrated
from calib.robot.chain import Chain
from calib.units import TORQUE, headings, per_ampere, without_gains

# of torques_1.csv [Hz]
TORQUE_RATE = 100.0

INSTRUMENTAL = "instrumental.csv"
RECORDINGS = "recordings.json"
COMPLIANCE_HEADER = (
    "joint",
    folders.COMPLIANCE,
    "sigma",
    "identified",
    "difference [mrad]",
    "without delay [mrad]",
    "residual [mrad]",
)
# statuses of gains in tables
GAIN_STATUS = {"told": "identified", "not told": "not identified", "reference": "reference"}
OURS = (
    calibrated.ROBOT,
    MODEL,
    folders.ESTIMATE,
    folders.COVARIANCE,
    information.INFORMATION,
    INSTRUMENTAL,
    RECORDINGS,
    folders.JOINT_COMPLIANCE,
    folders.METRICS,
    "drive_gains.csv",
    folders.REPORT,
    *folders.PAGES,
    "torques_1.csv",
    calibrated.COVARIANCE,
    geometry_tables.EFFECTS,
    geometry_tables.SENSITIVITY,
    geometry_tables.GEOMETRIES,
    geometry_tables.TORQUE_COVARIANCE,
    with_geometry.TABLE,
    with_geometry.COVARIANCE,
    *folders.figure_files("torque_[0-9]*", "velocity_[0-9]*", "errors", "residuals", "friction", "significance"),
    *folders.figure_files("geometries", "geometry_effects"),
)
"""Files of an earlier identification that a new one replaces."""
INSTRUMENTAL_HEADER = ("name", "unit", "instrumental", "sigma", "least_squares", "shift_sigma", "explained_percent")
HEADER = ("name", "expression", "unit", "value", "sigma", "rsd [%]", "essential", "sigma_torque", "sigma_geometry")


class _Essential(NamedTuple):
    name: str
    essential: float | None


@dataclass(frozen=True)
class IdentificationFolder:
    """Result folder of an identification: paths of its files, and functions that read them."""

    path: Path

    robot = folders.InFolder(calibrated.ROBOT)
    model = folders.InFolder(MODEL)
    numbers = folders.InFolder(folders.METRICS)  # with verdict and findings
    recordings = folders.InFolder(RECORDINGS)

    def identified_from(self) -> tuple[Fingerprint, ...]:
        """Read the fingerprints of the recordings that were identified from; folders of earlier versions have none."""
        if not self.recordings.is_file():
            return ()
        return read_json(self.recordings, "identify again", Fingerprints).recordings

    @property
    def tables(self) -> tuple[Path, Path]:
        """Paths of the parameter estimate (``estimate.csv``) and its covariance (``covariance.csv``)."""
        return self.path / folders.ESTIMATE, self.path / folders.COVARIANCE

    @property
    def torques(self) -> list[Path]:
        """Paths of the tables of measured and predicted torques on held-out motion.

        Without held-out motion: the table of the first training recording.
        """
        paths = self.unseen.path.glob("torques_*.csv")
        return sorted(paths, key=_number_of_table) or [self.path / "torques_1.csv"]

    def scores_of_torques(self) -> Sequence[Score | None]:
        """Read the scores of the model on the recordings of the tables `torques`; None if they are not stored."""
        if not (self.unseen.report.is_file() or (self.path / folders.REPORT).is_file()):
            return [None] * len(self.torques)
        report = self.judged
        scores = {**report.fit, **report.validation}
        return [scores[curves.name] for curves in report.curves]

    @property
    def unseen(self) -> UnseenFolder:
        """Folder with the model's validation on held-out motion, which only sessions write."""
        return UnseenFolder(self.path / "unseen")

    @property
    def judged(self) -> UnseenReport:
        """Report of the model's errors on held-out motion.

        It is the session's report if there is one, otherwise the report that `calib identify` wrote.
        """
        return (self.unseen if self.unseen.report.is_file() else UnseenFolder(self.path)).read()

    def dynamics(self) -> Dynamics:
        """Return the identified dynamic model, read from the folder."""
        return read_dynamics(self.path)[1]

    def metrics(self) -> ModelMetrics:
        """Return the content of ``metrics.json``."""
        return read_json(self.numbers, "identify again", ModelMetrics, with_current_keys)

    def findings(self) -> ModelFindings:
        """Read the findings on the model; folders of earlier versions contain only warnings as text."""
        metrics = self.metrics()
        return metrics.findings or ModelFindings(Resting(), metrics.warnings)

    def essential(self) -> tuple[str, ...]:
        """Read the names of the essential parameters."""
        return tuple(row.name for row in folders.read_estimate(self.path, _Essential) if row.essential is not None)

    def choice(self, chain: Chain) -> EarlierChoice:
        """Read the friction terms and the prior that the identification chose, for a later one of the same arm.

        Args:
            chain: the arm of the later identification.

        Raises:
            UsageError: for the folder of another arm, of an earlier version, or in amperes.
        """
        refuse_currents(self.path, "an identification that continues it")
        refuse_other_arm(self.path, chain)
        choice = self.metrics().choice
        if choice is None:
            raise UsageError(f"{self.path} is of an earlier version and does not state its choice; identify again")
        require(
            choice.is_valid,
            f"{self.numbers}: sizes, ridges and tempering of its choice are not positive numbers, or not one ridge and "
            "group per term; identify again",
            UsageError,
        )
        term_of = {term.name: term for term in self.dynamics().model.columns}
        with refused_as(
            UsageError, KeyError, f"{self.path}: metrics.json and dynamics.json do not agree ({{}}); identify again"
        ):
            terms = tuple(term_of[name] for name in choice.terms)
        return EarlierChoice(str(self.path), terms, choice)

    def switched_off(self) -> tuple[str, ...]:
        """Read the names of the drive terms that the evidence switched off; none where no metrics are stored."""
        return self.metrics().switched_off if self.numbers.is_file() else ()

    def errors(self) -> TorqueErrorModel | None:
        """Read the model of expected torque errors; None if the folder contains no errors or no covariance."""
        discrepancy = self.findings().errors
        if discrepancy is None:
            return None
        uncertainty = read_uncertainty(self.path, self.dynamics(), ())
        if uncertainty is None:
            return None
        return TorqueErrorModel(uncertainty.columns, uncertainty.covariance, discrepancy)


def continuing(inputs: IdentificationInputs, earlier: Path) -> IdentificationInputs:
    """Return the inputs of an identification that carries on the choice of an earlier one.

    Args:
        inputs: robot, recordings and options.
        earlier: folder of the earlier identification.

    Raises:
        UsageError: for a folder that is not of the same arm, and for options that choose friction or have no prior.
    """
    settings = inputs.options.settings
    if not method_named(settings.method).takes_prior:
        raise UsageError(f"after: method '{settings.method}' has no prior that could be carried on; use wls")
    if settings.prior == "none":
        raise UsageError(f"after: prior = 'none' leaves nothing of the prior of {earlier}; leave one of them out")
    if settings.friction != "auto":
        raise UsageError(
            f"after: {earlier} states the friction, and so does friction = '{settings.friction}'; leave one of them out"
        )
    if inputs.unit != TORQUE:
        refuse_option("after", f"torques are {without_gains(inputs.unit)}; state gains = [...] (N m/A)")
    folder = IdentificationFolder(earlier)
    seen = _identified_before(inputs.unseen, folder.identified_from())
    choice = replace(folder.choice(inputs.chain), seen=seen)
    options = replace(inputs.options, settings=replace(settings, earlier=choice))
    return replace(inputs, options=options)


def _identified_before(cases: Sequence[Case], recordings: Sequence[Fingerprint]) -> tuple[str, ...]:
    """Return the names of the recordings whose samples are among those that a model was identified from.

    Args:
        cases: recordings, recognised under any name.
        recordings: fingerprints of those that the model was identified from.
    """
    known = []
    for case in cases:
        hashes = case.motion.hashes
        if hashes is not None and any(common_share(hashes, recording.hashes) for recording in recordings):
            known.append(case.name)
    return tuple(known)


def _number_of_table(path: Path) -> int:
    """Return the number in the file name of a table of torques, such as 12 for ``torques_12.csv``."""
    return int(path.stem.rpartition("_")[2])


@dataclass(frozen=True)
class UnseenFolder:
    """Folder with an identified model's validation on held-out motion."""

    path: Path

    report = folders.InFolder(folders.REPORT)  # scores, verdict, and curves for the certificate

    def write(self, inputs: IdentificationInputs, assessment: DynamicsAssessment) -> None:
        """Write one table of torques for each held-out recording, and the report on the model's errors.

        Args:
            inputs: robot, recordings and options.
            assessment: the model's predictions and errors on the held-out recordings, and the verdict.
        """
        nominal = geometry_tables.on_nominal_geometry(self.path.parent)
        for number, case in enumerate(inputs.unseen, 1):
            _write_torques(inputs, case, assessment, nominal, self.path / f"torques_{number}.csv")
        files.write_json(self.report, UnseenReport.of(inputs, assessment))

    def read(self) -> UnseenReport:
        """Read the report on the model's errors."""
        return read_json(self.report, "identify again", UnseenReport, with_current_keys)


def check_identification_target(out: Path, inputs: Sequence[str | Path | None] = ()) -> None:
    """Check that results can be written into a folder.

    Args:
        out: the output folder; it need not exist.
        inputs: files that the command reads; None entries are ignored.

    Raises:
        UsageError: if the folder contains an input file, or files that no identification writes.
    """
    folders.check_target(out, OURS, (folders.METRICS, MODEL), "identification", inputs)


def write_folder(
    outcome: IdentificationOutcome,
    out: Path,
    plots: Callable[[IdentificationOutcome, Path], None] | None = None,
    *,
    owned: bool = False,
) -> Path:
    """Write the result folder of an identification and return its path; on an error, nothing is written.

    Args:
        outcome: the identification.
        out: path of the folder.
        plots: function that writes figures into the folder; None: no figures.
        owned: whether the folder belongs to the procedure, so that its content is replaced without a check.

    Raises:
        UsageError: if a folder that is not owned contains input files, or files that no identification writes.
    """
    if not owned:
        check_identification_target(out, [outcome.inputs.source, outcome.inputs.source.parent])

    def write(folder: Path) -> None:
        _write_all(outcome, folder)
        if plots is not None:
            plots(outcome, folder)

    return folders.write_staged(out, OURS, write)


def _write_all(outcome: IdentificationOutcome, folder: Path) -> None:
    """Write all files of an identification into a folder, except figures and report pages.

    Args:
        outcome: the identification with its errors and verdict.
        folder: the folder.
    """
    inputs, identification = outcome.inputs, outcome.found
    robot = inputs.robot
    if isinstance(robot, Mechanism):
        robot.write(folder)
    else:
        described = replace(robot, nominal=robot.nominal or inputs.chain, source=str(inputs.source))
        calibrated.write(folder, described, comment=f"identified from {inputs.source}")

    files.write_table(folder / folders.ESTIMATE, HEADER, _estimate_rows(outcome))
    covariance = identification.fitted.estimate.covariance
    if outcome.carried is not None:
        covariance = outcome.carried.covariance
    folders.write_covariance(folder / folders.COVARIANCE, identification.names, covariance)
    geometry_tables.write(outcome, folder)
    if outcome.jointly is not None and outcome.carried is not None:
        with_geometry.write(outcome.jointly, outcome.carried, folder)
    if identification.loop.table:
        files.write_table(folder / INSTRUMENTAL, INSTRUMENTAL_HEADER, identification.loop.table)
    # without a prior and constraints, estimate and covariance say it all
    constrained = identification.fitted.held
    binding = constrained is not None and (constrained.binding or constrained.postures)
    if identification.prior is not None or binding:
        information.write(identification, folder)

    difference = encoder_difference(identification.dynamics, inputs.cases)
    if difference is not None:
        compliance_rows = [_compliance_row(joint, inputs.chain.joint_names) for joint in difference.joints]
        files.write_table(folder / folders.JOINT_COMPLIANCE, COMPLIANCE_HEADER, compliance_rows)

    gains = None if inputs.gains is None else GainRecord.of(inputs.gains, inputs.unit)
    model_table = robot.model_table if isinstance(robot, Mechanism) else to_table
    table = model_table(identification.dynamics, identification.base, inputs.unit)
    files.write_json(folder / MODEL, table | {"drive_gains": gains})
    first = (*inputs.unseen, *inputs.cases)[0]
    nominal = geometry_tables.on_nominal_geometry(folder)
    _write_torques(inputs, first, outcome, nominal, folder / "torques_1.csv")
    if gains is not None:
        header = ("joint", f"gain [{gains.unit}]", f"sigma [{gains.unit}]", "status")
        status = [GAIN_STATUS[text] for text in gains.told]
        rows = zip(inputs.chain.joint_names, plain(gains.values), plain(gains.sigma), status)
        files.write_table(folder / "drive_gains.csv", header, rows)
    files.write_json(folder / folders.METRICS, metrics(outcome))
    files.write_json(folder / RECORDINGS, _fingerprints(inputs.cases))


def _fingerprints(cases: Sequence[Case]) -> Fingerprints:
    """Return the fingerprints of recordings, by which an update recognises them."""
    recordings: list[Fingerprint] = []
    for case in cases:
        motion = case.motion
        if motion.hashes is not None:
            recordings += [Fingerprint.of(case.name, motion.file, motion.hashes)]
    return Fingerprints(tuple(recordings))


def _compliance_row(joint: JointCompliance, names: Sequence[str]) -> tuple[object, ...]:
    """Return the row of ``joint_compliance.csv`` for a joint with two encoders, in the order of `COMPLIANCE_HEADER`."""
    milli = [1e3 * size for size in (joint.difference, joint.delayed, joint.residual)]
    return (names[joint.joint], joint.compliance, joint.sigma, "yes" if joint.identified else "no", *milli)


def _write_torques(
    inputs: IdentificationInputs, case: Case, errors: RecordingErrors, nominal: Dynamics | None, path: Path
) -> Path:
    """Write a table of measured and predicted torques and joint positions of a recording, at about `TORQUE_RATE`.

    Where intervals are known, two columns are added: the expected standard deviation of the torque error, and whether
    the model extrapolates (1) or not (0). Recordings without a payload also get velocities and accelerations, which
    `read_torques` requires.

    Args:
        inputs: robot and options of the identification.
        case: the recording with N samples.
        errors: torques predicted by the model, and their expected errors.
        nominal: the model identified on the nominal geometry, whose torques are written too; None: none.
        path: path of the table.
    """
    motion = case.motion
    rows = np.arange(0, len(motion), max(1, round(motion.rate / TORQUE_RATE)))
    predicted = errors.predictions[case.name]
    columns = {"measured": case.target[rows], "predicted": predicted[rows], "q": motion.q[rows]}
    if nominal is not None:
        undeflected = replace(case, link=None)
        columns["nominal"] = predict(nominal, undeflected)[rows]
    intervals = errors.intervals.get(case.name)
    if intervals is not None:
        nearest = np.searchsorted(intervals.index, rows)
        columns |= {"sigma": intervals.sigma[nearest], "extrapolated": intervals.beyond[nearest]}
    if not case.carried:
        columns |= {"v": motion.v[rows], "a": motion.a[rows]}

    titles = inputs.options.settings.torque_rows.titles(inputs.chain.joint_names)
    names = ["t [s]"]
    for quantity, values in columns.items():
        if values.ndim == 1:
            names.append(quantity)
        elif quantity in ("q", "v", "a"):
            names += headings(quantity, inputs.chain.joints)
        else:
            names += [f"{quantity}_{title} [{unit}]" for title, unit in zip(titles, inputs.row_units)]
    return files.write_numbers(path, names, np.column_stack([motion.t[rows], *columns.values()]))


def read_torques(path: Path) -> dict[str, np.ndarray]:
    """Read a table of torques written for a recording without a payload.

    Args:
        path: the CSV file.

    Returns:
        Arrays by name: measured and predicted torques (N, rows), and joint positions q, velocities v and accelerations
        a (N, n); empty if the table has no velocities and accelerations.
    """
    table = read_table(path)
    blocks = {}
    for name in ("measured", "predicted", "q", "v", "a"):
        block = table.block(name)
        if block is not None:
            blocks[name] = block
    return blocks if "v" in blocks else {}


def _estimate_rows(outcome: IdentificationOutcome) -> list[tuple[object, ...]]:
    """Return the rows of ``estimate.csv``, one for each parameter, with the columns `HEADER`.

    The σ of a parameter is its total σ, from torque noise and geometry; the relative standard deviation (RSD) is in
    percent. The σ from the geometry is NaN if the geometry is taken as exact. Friction terms that were switched off,
    and parameters fixed by a constraint, have no σ (NaN), because they were not estimated from the measurement.

    Args:
        outcome: the identification with its errors and verdict.
    """
    identification, carried = outcome.found, outcome.carried
    estimate = identification.fitted.estimate
    bound = on_bounds(identification)
    unmeasured = (*identification.friction.off, *bound)
    contents = _expressions(identification, unmeasured, bound)

    sigma, sigma_geometry = estimate.sigma, np.full(len(estimate.values), np.nan)
    if carried is not None:
        sigma = carried.sigma
        if carried.geometry is not None:
            sigma_geometry = carried.sigma_geometry
    with np.errstate(divide="ignore", invalid="ignore"):
        rsd = 100.0 * sigma / np.abs(estimate.values)
    is_unmeasured = np.isin(identification.names, unmeasured)
    rsd = np.where(np.isfinite(rsd) & ~is_unmeasured, rsd, np.nan)
    sigma = np.where(is_unmeasured, np.nan, sigma)
    sigma_torque = np.where(is_unmeasured, np.nan, estimate.sigma)
    sigma_geometry = np.where(is_unmeasured, np.nan, sigma_geometry)

    essential: dict[str, float] = {}
    if identification.elimination is not None:
        remaining = identification.elimination.essential.estimate
        essential = dict(zip(remaining.names, remaining.values))
    rows = []
    for k, name in enumerate(identification.names):
        unit = per_ampere(estimate.units[k], outcome.inputs.unit)
        value_essential = essential.get(estimate.names[k])
        sigmas = sigma_torque[k], sigma_geometry[k]
        rows.append((name, contents[k], unit, estimate.values[k], sigma[k], rsd[k], value_essential, *sigmas))
    return rows


def _expressions(identification: Identification, unmeasured: Sequence[str], bound: Sequence[str]) -> list[str]:
    """Return for each parameter a text that explains it.

    The text is a combination of standard parameters, or the name of a drive term's shape (such as a friction term).

    Args:
        identification: the identification.
        unmeasured: names of the drive terms that were switched off since nothing was measured for them.
        bound: names of the parameters that a constraint fixes at its bound.
    """
    lines = [line.split(" = ", 1)[1] for line in expressions(identification.base)]
    for term in identification.friction.terms:
        remark = ", switched off: not measured" if term.name in unmeasured else ""
        lines.append(f"{term.shape}{remark}")
    for k, name in enumerate(identification.names):
        if name in bound:
            lines[k] += ", on its bound: no sigma"
    return lines
