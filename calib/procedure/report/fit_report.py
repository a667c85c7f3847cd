"""The data of a fit's report and certificate, plain numbers in ``report.json``, from which both can be made again."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from calib import files
from calib.data.poses import IMAGES
from calib.data.poses.measurements import PoseMeasurements
from calib.errors import UsageError
from calib.extensions import Point
from calib.geometry.observation import layout, positions, prepare
from calib.procedure.kinematic_stage.comparison import Comparison
from calib.procedure.kinematic_stage.fit import Outcome
from calib.procedure.kinematic_stage.folder import metrics
from calib.procedure.kinematic_stage.inputs import Inputs
from calib.procedure.kinematic_stage.metrics import FitMetrics, ImageCoverage, ValidationMetrics
from calib.procedure.kinematic_stage.tables import estimate_table
from calib.procedure.kinematic_stage.validation import ARM
from calib.procedure.report.page import FileRow
from calib.records import read_json
from calib.transforms import invert

IMAGE_COVERAGE: Point[Callable[[Any], list[Any]]] = Point("image_coverage", "how a fit's images cover the view")

SCHEMA = 2
READ = (1, SCHEMA)  # 1 kept the findings here, too
NATURES = ("position", "orientation", "distance")
CROSS_VALIDATED = "cross-validated"  # name of a set of rows that folds of the fit left out in turn


class FittedParameter(NamedTuple):
    """One parameter of the fit; `rsd` in percent, `group` arm, station, tool or deflection."""

    name: str
    unit: str
    nominal: float
    value: float
    sigma: float
    rsd: float | None
    group: str


class CorrelatedPair(NamedTuple):
    """Two correlated parameters."""

    first: str
    second: str
    correlation: float


@dataclass(frozen=True)
class CorrelationMatrix:
    """Correlation matrix of the most correlated parameters."""

    names: tuple[str, ...]
    matrix: tuple[tuple[float, ...], ...]


SHOWN = 2000  # rows that figures show at most


@dataclass(frozen=True)
class RowErrors:
    """Error sizes on one set of rows.

    Attributes:
        name: of the set; ``fit``, or a validation file's.
        unseen: whether the fit had not seen them.
        poses: how many robot poses.
        nominal, calibrated, urdf_alone: by nature, the errors of that arm [m, rad].
        expected: radius within which 95 % of the calibrated arm's errors are to be [m]; empty where none is known.
        q: (rows, n) joints, points (rows, 3) in the arm's base, and numbers of the file's rows, where there is one
            error per row.
        worst: the row with the calibrated arm's largest error, where only a sample of the rows stands here.
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

    def judged(self, deliverable: str) -> Mapping[str, tuple[float, ...]]:
        """Return the errors of the deliverable on which the verdict is based, by nature."""
        return self.calibrated if deliverable != "urdf" or not self.urdf_alone else self.urdf_alone

    def judged_arm(self, deliverable: str) -> str:
        """Return the words for that deliverable."""
        with_corrections = deliverable != "urdf" and self.urdf_alone
        return ARM["corrections"] if with_corrections else ARM["urdf"]


@dataclass(frozen=True)
class Report:
    """The outcome of a fit, as stored in JSON.

    Attributes:
        robot: its name; base and tip links.
        joints: names; ``prismatic`` says which slide.
        metrics: as in ``metrics.json``.
        parameters: all that were fitted.
        kept: arm parameters that stayed at their nominal.
        correlations: pairs that go together.
        correlated: the parameters that go together most.
        singular_values: of the scaled observation matrix; `rank` of them are kept.
        sets: errors per set of rows.
        noise: what the stated sigmas alone give, rms by nature [m, rad]; None where none were stated.
        images: what each camera's images show of it; empty without any.
        files: what was read, see `file_row`.
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

    def with_unseen(self, found: ValidationMetrics, sets: Sequence[RowErrors]) -> Report:
        """Return the report, extended by unseen rows (`rows_of`) and updated verdict, reason and warnings."""
        metrics = replace(self.metrics, **vars(found))
        fresh = {one.name for one in sets}
        return replace(self, metrics=metrics, sets=(*(one for one in self.sets if one.name not in fresh), *sets))


def collect(outcome: Outcome) -> Report:
    """Return the report of a fit's outcome, for its certificate."""
    chain, fit = outcome.inputs.chain, outcome.selection.fit
    table, names = estimate_table(fit, outcome.selection.nominal.cell), layout(fit.cell)
    groups = dict(zip(names.names, names.kinds))
    fitted = set(table.names)
    sets = [rows_of("fit", outcome.fit, False)]
    sets += [rows_of(name, found, found.proves) for name, found in outcome.validation.items()]
    values = [] if fit.split is None else fit.split.singular_values.tolist()
    return Report(
        schema=SCHEMA,
        robot=chain.name,
        base=chain.base,
        tip=chain.tip,
        joints=tuple(chain.joint_names),
        prismatic=tuple(joint.kind == "prismatic" for joint in chain.joints),
        metrics=metrics(outcome),
        parameters=tuple(FittedParameter(*row, groups[row[0]]) for row in table.rows()),
        kept=tuple(name for name in chain.names if name not in fitted),
        correlations=tuple(CorrelatedPair(*pair) for pair in fit.estimate.strong_correlations(0.9)),
        correlated=most_correlated(table.names, table.covariance),
        singular_values=tuple(values),
        rank=len(values) if fit.split is None else fit.split.rank,
        sets=tuple(sets),
        noise=_noise(outcome.fit.blocks),
        images=tuple(each for coverage in IMAGE_COVERAGE.all() for each in coverage(fit)),
        files=_files(outcome.inputs),
        source=str(outcome.inputs.source),
    )


def file_row(name: str, role: str, path: Path) -> FileRow:
    """Return the entry of a file in the certificate: name, content, bytes, SHA-256."""
    return name, role, str(path.stat().st_size), files.fingerprint(path)


def unseen_role(role: str, seen: bool, judged: str) -> str:
    """Return the role of a validation file, and whether the file was unseen by `judged` (fit or identification)."""
    return f"{role}, {'NOT unseen' if seen else 'unseen'} by {judged}"


def _files(inputs: Inputs) -> tuple[FileRow, ...]:
    """Return the entries of the robot's description and of the files for fit and validation."""
    found = {inputs.source: "nominal robot", **{Path(block.file): "measured" for block in inputs.fit if block.file}}
    for unseen in inputs.unseen.values():
        if not unseen.held_out and unseen.block.file:
            found.setdefault(Path(unseen.block.file), unseen_role("measured", unseen.seen, "the fit"))
    return tuple(file_row(path.name, role, path) for path, role in found.items() if path.is_file())


def rows_of(name: str, comparison: Comparison, unseen: bool) -> RowErrors:
    """Return the errors of one set of rows, with joint values and target positions if each row has one error.

    Of more than `SHOWN` such rows a random sample, and the worst.
    """
    sizes = comparison.errors[1].main
    points = _points(comparison) if len(sizes) == sum(map(len, comparison.blocks)) else None
    chosen = partial(_row_errors, name, comparison, unseen, points)
    if points is None or len(sizes) <= SHOWN:
        return chosen(slice(None))
    some = np.sort(np.random.default_rng(0).choice(len(sizes), SHOWN, replace=False))
    return replace(chosen(some), worst=chosen(np.array([np.argmax(sizes)])))


def _row_errors(
    name: str, comparison: Comparison, unseen: bool, points: np.ndarray | None, chosen: slice | np.ndarray
) -> RowErrors:
    """Return the errors of the chosen rows; with joints and `points` (rows, 3) where each row has one error."""
    nominal, calibrated, alone = (
        {nature: _plain(size[chosen]) for nature in NATURES if (size := getattr(found, nature, None)) is not None}
        for found in (*comparison.errors, comparison.alone)
    )
    rows = RowErrors(name, unseen, comparison.poses, nominal, calibrated, urdf_alone=alone)
    if points is None:
        return rows
    q = np.concatenate([block.q for block in comparison.blocks])
    expected = () if comparison.intervals is None else _plain(comparison.intervals.radius[chosen])
    numbers = np.concatenate([block.rows for block in comparison.blocks])[chosen]
    return replace(
        rows, q=_plain(q[chosen]), points=_plain(points[chosen]), expected=expected, rows=tuple(map(int, numbers))
    )


def _points(comparison: Comparison) -> np.ndarray:
    """Return the target positions (rows, 3) [m] in the arm's base frame."""
    cell, points = comparison.cells[1], []
    for block in prepare(cell, comparison.blocks):
        point = positions(cell, block).T
        base = cell.stations[block.station] if block.measured.has_instrument else cell.stations[0]
        back = invert(base)
        points.append(point @ back[:3, :3].T + back[:3, 3])
    return np.concatenate(points)


def most_correlated(names: Sequence[str], covariance: np.ndarray, most: int = 12) -> CorrelationMatrix:
    """Return the most correlated parameters and their correlation matrix."""
    sigma = np.sqrt(np.clip(np.diag(covariance), 1e-300, None))
    matrix = covariance / np.outer(sigma, sigma)
    off = np.abs(matrix - np.diag(np.diag(matrix))).max(axis=1, initial=0.0)
    chosen = np.sort(np.argsort(-off, kind="stable")[:most])
    return CorrelationMatrix(tuple(str(names[k]) for k in chosen), _plain(matrix[np.ix_(chosen, chosen)]))


def _noise(blocks: Sequence[PoseMeasurements]) -> dict[str, float | None]:
    result: dict[str, float | None] = {}
    for nature, name in (("position", "sigma"), ("orientation", "sigma_rotation")):
        found = [(block, None if block.kind == IMAGES else getattr(block, name, None)) for block in blocks]
        # a kind with one number per row states it for each axis
        stated = [np.broadcast_to(s.reshape(len(block), -1), (len(block), 3)) for block, s in found if s is not None]
        whole = len(stated) == len(blocks)
        result[nature] = float(np.sqrt(np.mean(np.sum(np.concatenate(stated) ** 2, axis=1)))) if whole else None
    return result


def _plain(values: np.ndarray) -> tuple[Any, ...]:
    """Return numbers rounded to seven digits, as nested tuples."""
    rounded = np.array([float(f"{value:.7g}") for value in np.ravel(values)]).reshape(np.shape(values))
    return tuple(rounded.tolist()) if rounded.ndim == 1 else tuple(map(tuple, rounded.tolist()))


def write(report: Report, path: Path) -> None:
    """Write a fit's report as JSON."""
    files.write_json(path, report)


def read(path: Path) -> Report:
    """Read a fit's report from JSON.

    Raises:
        UsageError: where it is missing or made by another version.
    """
    schema = read_json(path, "fit again").get("schema")
    if schema not in READ:
        raise UsageError(f"{path}: schema {schema}, this version reads {SCHEMA}; fit again")
    return read_json(path, "fit again", Report)
