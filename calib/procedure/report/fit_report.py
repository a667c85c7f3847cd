"""Content of a fit's report and certificate as plain numbers, stored in ``report.json``; both are rendered from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from calib import files
from calib.data.poses import IMAGES
from calib.data.poses.measurements import PoseMeasurements
from calib.errors import UsageError
from calib.geometry.observation import layout, positions, prepare
from calib.procedure.kinematic_stage.fit import Outcome
from calib.procedure.kinematic_stage.fit_tables import estimate_table
from calib.procedure.kinematic_stage.folder import metrics
from calib.procedure.kinematic_stage.inputs import Inputs
from calib.procedure.kinematic_stage.metrics import FitMetrics, ImageCoverage, ValidationMetrics
from calib.procedure.kinematic_stage.verdict.comparison import Comparison
from calib.procedure.kinematic_stage.verdict.image_findings import image_coverage
from calib.procedure.kinematic_stage.verdict.validation import ARM
from calib.procedure.report.page import FileRow
from calib.records import read_json
from calib.transforms import invert

# version of ``report.json``, and those that can be read: 1 kept the findings in it, too
SCHEMA = 2
READABLE_SCHEMAS = (1, SCHEMA)
# name of a set of rows that folds of the fit left out in turn
CROSS_VALIDATED = "cross-validated"
# rows that figures show at most
MAX_ROWS = 2000
# absolute correlation from which on a pair of parameters is listed
STRONG_CORRELATION = 0.9

NATURES = ("position", "orientation", "distance")


class FittedParameter(NamedTuple):
    """One fitted parameter.

    The relative standard deviation `rsd` is in percent (None: undefined); `group` is arm, station, tool or deflection.
    """

    name: str
    unit: str
    nominal: float
    value: float
    sigma: float
    rsd: float | None
    group: str


class CorrelatedPair(NamedTuple):
    """Names of two correlated parameters, and their correlation coefficient."""

    first: str
    second: str
    correlation: float


@dataclass(frozen=True)
class CorrelationMatrix:
    """Names and correlation matrix of the most strongly correlated parameters."""

    names: tuple[str, ...]
    matrix: tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class RowErrors:
    """Error sizes on one set of measured rows.

    Attributes:
        name: name of the set: ``fit``, or the validation file's name.
        unseen: whether the rows were held out from the fit.
        poses: number of robot poses.
        nominal, calibrated, urdf_alone: errors of the nominal arm, the calibrated arm, and the calibrated arm without
            joint corrections: nature (position, orientation, distance) -> errors [m, rad].
        expected: predicted radius that contains 95 % of the calibrated arm's errors [m]; empty: unknown.
        q: (rows, n) joint values [rad or m]; empty if several rows share an error, as are `points` and `rows`.
        points: (rows, 3) target positions in the arm's base frame [m].
        rows: row numbers in the file.
        files: names of the files of the rows.
        file: index of each row's file.
        worst: the row with the calibrated arm's largest error, if the set is only a sample of the rows; otherwise None.
    """

    name: str
    unseen: bool
    poses: int
    nominal: Mapping[str, tuple[float, ...]]
    calibrated: Mapping[str, tuple[float, ...]]
    q: tuple[tuple[float, ...], ...] = ()
    points: tuple[tuple[float, ...], ...] = ()
    expected: tuple[float, ...] = ()
    urdf_alone: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    rows: tuple[int, ...] = ()
    worst: RowErrors | None = None
    files: tuple[str, ...] = ()
    file: tuple[int, ...] = ()

    def judged(self, deliverable: str) -> Mapping[str, tuple[float, ...]]:
        """Return the errors of the deliverable that is judged, by nature (position, orientation, distance) [m, rad].

        Args:
            deliverable: ``urdf`` or ``corrections``.
        """
        if deliverable == "urdf" and self.urdf_alone:
            return self.urdf_alone
        return self.calibrated

    def judged_arm(self, deliverable: str) -> str:
        """Return the printed name of the deliverable that is judged.

        Args:
            deliverable: ``urdf`` or ``corrections``.
        """
        with_corrections = deliverable != "urdf" and self.urdf_alone
        return ARM["corrections"] if with_corrections else ARM["urdf"]


@dataclass(frozen=True)
class Report:
    """The results of a fit, as stored in ``report.json``.

    Attributes:
        schema: version of the file's format.
        robot: name of the robot.
        base, tip: names of the first and the last link.
        joints: names of the joints.
        prismatic: whether each joint is prismatic.
        metrics: content of ``metrics.json``.
        parameters: all fitted parameters.
        kept: names of the arm parameters that kept their nominal values.
        correlations: pairs of strongly correlated parameters.
        correlated: correlation matrix of the most correlated parameters.
        singular_values: singular values of the scaled observation matrix.
        rank: number of singular values that are kept.
        sets: errors on each set of rows.
        noise: nature (position, orientation) -> rms error that the instrument's stated σ alone causes [m, rad]; None:
            no σ was stated.
        images: density of detected corners over each camera's images; empty: no images.
        files: files that were read: name, role, size in bytes, SHA-256.
        source: path of the robot's description.
    """

    schema: int
    robot: str
    base: str
    tip: str
    joints: tuple[str, ...]
    prismatic: tuple[bool, ...]
    metrics: FitMetrics
    parameters: tuple[FittedParameter, ...]
    kept: tuple[str, ...]
    correlations: tuple[CorrelatedPair, ...]
    correlated: CorrelationMatrix
    singular_values: tuple[float, ...]
    rank: int
    sets: tuple[RowErrors, ...]
    noise: Mapping[str, float | None]
    images: tuple[ImageCoverage, ...] = ()
    files: tuple[FileRow, ...] = ()
    source: str = ""

    def with_unseen(self, validation: ValidationMetrics, sets: Sequence[RowErrors]) -> Report:
        """Return the report with further held-out rows (`rows_of`), and with updated verdict, reason and warnings.

        Args:
            validation: new results on validation rows, with the verdict.
            sets: errors on the further rows; a set with the name of an earlier one replaces it.
        """
        metrics = replace(self.metrics, **vars(validation))
        replaced = {rows.name for rows in sets}
        remaining = [rows for rows in self.sets if rows.name not in replaced]
        return replace(self, metrics=metrics, sets=(*remaining, *sets))


def collect(outcome: Outcome) -> Report:
    """Return the report on the outcome of a fit."""
    chain, fit = outcome.inputs.chain, outcome.selection.fit
    table = estimate_table(fit, outcome.selection.nominal.cell)
    names = layout(fit.cell)
    groups = dict(zip(names.names, names.kinds))
    parameters = [FittedParameter(*row, groups[row[0]]) for row in table.rows()]
    fitted = set(table.names)
    fixed = [name for name in chain.names if name not in fitted]
    correlations = [CorrelatedPair(*pair) for pair in fit.estimate.strong_correlations(STRONG_CORRELATION)]

    sets = [rows_of("fit", outcome.fit, False)]
    for name, comparison in outcome.validation.items():
        sets.append(rows_of(name, comparison, comparison.proves))
    values: list[float] = []
    rank = 0
    if fit.split is not None:
        values = fit.split.singular_values.tolist()
        rank = fit.split.rank

    return Report(
        schema=SCHEMA,
        robot=chain.name,
        base=chain.base,
        tip=chain.tip,
        joints=tuple(chain.joint_names),
        prismatic=tuple(joint.kind == "prismatic" for joint in chain.joints),
        metrics=metrics(outcome),
        parameters=tuple(parameters),
        kept=tuple(fixed),
        correlations=tuple(correlations),
        correlated=most_correlated(table.names, table.covariance),
        singular_values=tuple(values),
        rank=rank,
        sets=tuple(sets),
        noise=_noise(outcome.fit.blocks),
        images=image_coverage(fit),
        files=_file_rows(outcome.inputs),
        source=str(outcome.inputs.source),
    )


def file_row(name: str, role: str, path: Path) -> FileRow:
    """Return the entry of a file in the certificate: name, role, size in bytes, SHA-256.

    Args:
        name: printed name.
        role: use of the file, such as "nominal robot".
        path: the file.
    """
    return name, role, str(path.stat().st_size), files.fingerprint(path)


def unseen_role(role: str, seen: bool, judged: str) -> str:
    """Return a validation file's role as text, with a remark on whether the file was held out.

    Args:
        role: role of the file.
        seen: whether fit or identification used the file.
        judged: what is judged: ``the fit`` or ``the identification``.
    """
    unseen = "NOT unseen" if seen else "unseen"
    return f"{role}, {unseen} by {judged}"


def _file_rows(inputs: Inputs) -> tuple[FileRow, ...]:
    """Return the certificate's entries of the robot's description and of the files for fit and validation.

    Args:
        inputs: robot and measurements.
    """
    roles = {inputs.source: "nominal robot"}
    for block in inputs.fit:
        if block.file:
            roles[Path(block.file)] = "measured"
    for unseen in inputs.unseen.values():
        if not unseen.held_out and unseen.block.file:
            roles.setdefault(Path(unseen.block.file), unseen_role("measured", unseen.seen, "the fit"))
    return tuple(file_row(path.name, role, path) for path, role in roles.items() if path.is_file())


def rows_of(name: str, comparison: Comparison, unseen: bool) -> RowErrors:
    """Return the errors on one set of rows.

    Joint values and target positions are included if there is one error per row; distances between two rows, for
    example, have no row of their own. From more than `MAX_ROWS` rows, a random sample and the worst row are taken.

    Args:
        name: name of the set.
        comparison: errors of the arms on the rows.
        unseen: whether the rows were held out from the fit.
    """
    sizes = comparison.errors[1].main
    if len(sizes) != sum(map(len, comparison.blocks)):
        # several rows share an error: sockets, planes, distances
        return _errors_by_nature(name, comparison, unseen, slice(None))
    if len(sizes) <= MAX_ROWS:
        return _errors_by_row(name, comparison, unseen, slice(None))
    sample = np.random.default_rng(0).choice(len(sizes), MAX_ROWS, replace=False)
    worst = np.array([np.argmax(sizes)])
    return replace(
        _errors_by_row(name, comparison, unseen, np.sort(sample)), worst=_errors_by_row(name, comparison, unseen, worst)
    )


def _errors_by_nature(name: str, comparison: Comparison, unseen: bool, selection: slice | np.ndarray) -> RowErrors:
    """Return the selected errors of three arms: nominal, calibrated, and calibrated without joint corrections.

    Args:
        name: name of the set.
        comparison: errors of the arms on the rows.
        unseen: whether the rows were held out from the fit.
        selection: indices of the selected errors.
    """
    errors_by_arm = []
    for errors in (*comparison.errors, comparison.alone):
        by_nature = {}
        for nature in NATURES:
            sizes = getattr(errors, nature, None)
            if sizes is not None:
                by_nature[nature] = _plain(sizes[selection])
        errors_by_arm.append(by_nature)
    nominal, calibrated, urdf_alone = errors_by_arm
    return RowErrors(name, unseen, comparison.poses, nominal, calibrated, urdf_alone=urdf_alone)


def _errors_by_row(name: str, comparison: Comparison, unseen: bool, selection: slice | np.ndarray) -> RowErrors:
    """Return the errors of the selected rows with joint values, target positions, expected errors and row numbers.

    Args:
        name: name of the set.
        comparison: errors of the arms on the rows.
        unseen: whether the rows were held out from the fit.
        selection: indices of the selected rows.
    """
    q = np.concatenate([block.q for block in comparison.blocks])
    numbers = np.concatenate([block.rows for block in comparison.blocks])
    points = _points(comparison)
    paths = [block.file for block in comparison.blocks]
    files = list(dict.fromkeys(paths))
    file_numbers = np.repeat([files.index(path) for path in paths], [len(block) for block in comparison.blocks])
    expected: tuple[float, ...] = ()
    if comparison.intervals is not None:
        expected = _plain(comparison.intervals.radius[selection])
    return replace(
        _errors_by_nature(name, comparison, unseen, selection),
        q=_plain(q[selection]),
        points=_plain(points[selection]),
        expected=expected,
        rows=tuple(map(int, numbers[selection])),
        files=distinct_names(files),
        file=tuple(map(int, file_numbers[selection])),
    )


def distinct_names(paths: Sequence[str]) -> tuple[str, ...]:
    """Return a name for each of different files: that of the file, with as many folders as tell it from the others."""
    parts = [Path(path).parts for path in paths]
    names = []
    for number, path in enumerate(parts):
        others = parts[:number] + parts[number + 1 :]
        length = 1
        while length < len(path) and any(other[-length:] == path[-length:] for other in others):
            length += 1
        names.append("/".join(path[-length:]))
    return tuple(names)


def _points(comparison: Comparison) -> np.ndarray:
    """Return the positions (rows, 3) [m] of the targets in the arm's base frame, as predicted by the calibrated arm.

    Args:
        comparison: the rows, and the arms that predict them.
    """
    cell = comparison.cells[1]
    points = []
    for block in prepare(cell, comparison.blocks):
        station = cell.stations[block.station] if block.measured.has_instrument else cell.stations[0]
        T_base_station = invert(station)
        position = positions(cell, block).T
        points.append(position @ T_base_station[:3, :3].T + T_base_station[:3, 3])
    return np.concatenate(points)


def most_correlated(names: Sequence[str], covariance: np.ndarray, most: int = 12) -> CorrelationMatrix:
    """Return the correlation matrix of the `most` parameters with the strongest correlations.

    Args:
        names: names of p parameters.
        covariance: (p, p) covariance.
        most: largest number of parameters.
    """
    sigma = np.sqrt(np.clip(np.diag(covariance), 1e-300, None))
    matrix = covariance / np.outer(sigma, sigma)
    strongest = np.abs(matrix - np.diag(np.diag(matrix))).max(axis=1, initial=0.0)
    chosen = np.sort(np.argsort(-strongest, kind="stable")[:most])
    chosen_names = [str(names[k]) for k in chosen]
    return CorrelationMatrix(tuple(chosen_names), _plain(matrix[np.ix_(chosen, chosen)]))


def _noise(blocks: Sequence[PoseMeasurements]) -> dict[str, float | None]:
    """Return the rms errors that the stated σ alone cause: position [m] and orientation [rad].

    None for a nature whose σ is not stated for every block of measurements.
    """
    return {"position": _stated_rms(blocks, "sigma"), "orientation": _stated_rms(blocks, "sigma_rotation")}


def _stated_rms(blocks: Sequence[PoseMeasurements], field_name: str) -> float | None:
    sigmas = []
    for block in blocks:
        sigma = getattr(block, field_name, None)
        # the sigma of images is one of pixels
        if block.kind == IMAGES or sigma is None:
            return None
        # a kind with one number per row states it for each axis
        sigmas.append(np.broadcast_to(sigma.reshape(len(block), -1), (len(block), 3)))
    squares = np.sum(np.concatenate(sigmas) ** 2, axis=1)
    return float(np.sqrt(np.mean(squares)))


def _plain(values: np.ndarray) -> tuple[Any, ...]:
    """Return an array of numbers, rounded to seven significant digits, as a tuple or nested tuples.

    Args:
        values: the array.
    """
    rounded = [float(f"{value:.7g}") for value in np.ravel(values)]
    nested = np.array(rounded).reshape(np.shape(values)).tolist()
    if np.ndim(values) == 1:
        return tuple(nested)
    return tuple(map(tuple, nested))


def write(report: Report, path: Path) -> None:
    """Write a fit's report as JSON to a path."""
    files.write_json(path, report)


def read(path: Path) -> Report:
    """Return a fit's report, read from the JSON file `path`.

    Raises:
        UsageError: if the file is missing or was written by another version.
    """
    schema = read_json(path, "fit again").get("schema")
    if schema not in READABLE_SCHEMAS:
        raise UsageError(f"{path}: schema {schema}, this version reads {SCHEMA}; fit again")
    return read_json(path, "fit again", Report)
