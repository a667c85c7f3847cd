"""What a certificate is made from: plain numbers beside the fit's own files, so that it can be printed again any day.

`write` fits the place `plots` of `calib.procedure.kinematic_stage.folder.write_folder`: it leaves ``report.json`` and
``plot_*.png``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from calib.data.poses.measurements import PoseMeasurements
from calib.errors import UsageError
from calib.estimation.estimate import strong_correlations
from calib.geometry.observation import has_instrument, predict, prepare
from calib.geometry.parameters import layout
from calib.procedure.kinematic_stage.fit import Outcome, judged
from calib.procedure.kinematic_stage.folder import metrics
from calib.procedure.kinematic_stage.tables import estimate_table
from calib.procedure.kinematic_stage.validation import Comparison
from calib.transforms import invert

SCHEMA = 1
NATURES = ("position", "orientation", "distance")


@dataclass(frozen=True)
class Report:
    """The outcome of a fit as JSON holds it.

    Attributes:
        robot: its name; base and tip links.
        joints: names; ``prismatic`` says which slide.
        metrics: as in ``metrics.json``.
        parameters: name, unit, nominal, value, sigma, RSD [%] or None, and group (arm, station, tool, deflection).
        kept: arm parameters that stayed at their nominal.
        correlations: pairs that go together, and their correlation.
        correlated: names and correlation matrix of those parameters.
        singular_values: of the scaled observation matrix; `rank` of them are kept.
        sets: per set of rows: name, unseen, poses, errors of both arms by nature [m, rad], and where there is one error
            per row q (rows, n) and points (rows, 3) in the arm's base.
        noise: what the stated sigmas alone give, rms by nature [m, rad]; None where none were stated.
        judged: what `calib.procedure.kinematic_stage.verdict.judge` needs besides the errors.
        said: warnings that the fit alone gives, whatever the unseen rows are.
    """

    schema: int
    robot: str
    base: str
    tip: str
    joints: list[str]
    prismatic: list[bool]
    metrics: dict[str, Any]
    parameters: list[list[Any]]
    kept: list[str]
    correlations: list[list[Any]]
    correlated: dict[str, Any]
    singular_values: list[float]
    rank: int
    sets: list[dict[str, Any]]
    noise: dict[str, float | None]
    judged: dict[str, Any]
    said: list[str] = field(default_factory=list)


def collect(outcome: Outcome) -> Report:
    """Return what a certificate needs of a fit."""
    chain, fit = outcome.inputs.chain, outcome.climb.fit
    table, names = estimate_table(fit, outcome.climb.nominal.cell), layout(fit.cell)
    groups = {name: names.group(k) for k, name in enumerate(names.names)}
    fitted = set(table.names)
    sets = [rows_of("fit", outcome.fit, False)]
    sets += [rows_of(name, found, found.proves) for name, found in outcome.validation.items()]
    strong, matrix = _correlated(table.names, table.covariance)
    values = [] if fit.split is None else fit.split.singular_values.tolist()
    return Report(
        schema=SCHEMA,
        robot=chain.name,
        base=chain.base,
        tip=chain.tip,
        joints=list(chain.joint_names),
        prismatic=[joint.kind == "prismatic" for joint in chain.joints],
        metrics=metrics(outcome),
        parameters=[[*row, groups[row[0]]] for row in table.rows()],
        kept=[name for name in chain.names if name not in fitted],
        correlations=[list(pair) for pair in strong_correlations(fit.estimate, 0.9)],
        correlated={"names": strong, "matrix": matrix},
        singular_values=values,
        rank=len(values) if fit.split is None else fit.split.rank,
        sets=sets,
        noise=_noise(outcome.fit.blocks),
        judged=judged(outcome.inputs, outcome.climb, outcome.outliers),
        said=list(outcome.said),
    )


def rows_of(name: str, comparison: Comparison, unseen: bool) -> dict[str, Any]:
    """Return one set of rows: sizes of errors, and where they were measured if there is one error per row."""
    entry: dict[str, Any] = {"name": name, "unseen": unseen, "poses": comparison.poses}
    for arm, found in zip(("nominal", "calibrated"), comparison.errors):
        sizes = ((nature, getattr(found, nature)) for nature in NATURES)
        entry[arm] = {nature: _plain(size) for nature, size in sizes if size is not None}
    q = np.concatenate([block.q for block in comparison.blocks])
    if len(comparison.errors[1].main) == len(q):
        entry |= {"q": _plain(q), "points": _plain(_points(comparison))}
    return entry


def with_unseen(report: Report, metrics: Mapping[str, Any], sets: Sequence[Mapping[str, Any]]) -> Report:
    """Return a fit's report with rows it has not seen (`rows_of`), and verdict, reason and warnings that follow."""
    merged = {key: metrics[key] for key in ("validation", "verdict", "reason", "warnings")}
    return replace(report, metrics=report.metrics | merged, sets=[*report.sets, *map(dict, sets)])


def _points(comparison: Comparison) -> np.ndarray:
    """Return where the targets were, in the arm's base (rows, 3) [m]."""
    cell, points = comparison.cells[1], []
    for block in prepare(cell, comparison.blocks, comparison.torques):
        point = predict(cell, block).point.T
        base = cell.stations[block.station] if has_instrument(block.measured) else cell.stations[0]
        back = invert(base)
        points.append(point @ back[:3, :3].T + back[:3, 3])
    return np.concatenate(points)


def _correlated(names: Sequence[str], covariance: np.ndarray, most: int = 12) -> tuple[list[str], list[list[float]]]:
    """Return those parameters that go together most, and their correlation matrix."""
    sigma = np.sqrt(np.clip(np.diag(covariance), 1e-300, None))
    matrix = covariance / np.outer(sigma, sigma)
    off = np.abs(matrix - np.diag(np.diag(matrix))).max(axis=1, initial=0.0)
    chosen = np.sort(np.argsort(-off, kind="stable")[:most])
    return [str(names[k]) for k in chosen], _plain(matrix[np.ix_(chosen, chosen)])


def _noise(blocks: Sequence[PoseMeasurements]) -> dict[str, float | None]:
    result: dict[str, float | None] = {}
    for nature, name in (("position", "sigma"), ("orientation", "sigma_rotation")):
        stated = [sigma for block in blocks if (sigma := getattr(block, name)) is not None]
        whole = len(stated) == len(blocks)
        result[nature] = float(np.sqrt(np.mean(np.sum(np.concatenate(stated) ** 2, axis=1)))) if whole else None
    return result


def _plain(values: np.ndarray) -> Any:
    """Return numbers with seven digits, which is more than any figure shows."""
    rounded = np.array([float(f"{value:.7g}") for value in np.ravel(values)])
    return rounded.reshape(np.shape(values)).tolist()


def read(folder: Path) -> Report:
    """Read what `write` has left.

    Raises:
        UsageError: where it is missing or made by another version.
    """
    path = Path(folder) / "report.json"
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UsageError(f"{path}: {error}; fit again") from error
    if content.get("schema") != SCHEMA:
        raise UsageError(f"{path}: schema {content.get('schema')}, this version reads {SCHEMA}; fit again")
    return Report(**content)
