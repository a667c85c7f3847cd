"""Both arms on rows that were fitted and on rows that were not, and what that comes to: one assessment for all who ask.

`assess` is called by a fit that was just made and by one read back from its folder; they get the same answer.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from calib import files
from calib.data.poses.measurements import PoseMeasurements, Positions
from calib.errors import Finding, finding
from calib.geometry.accuracy import Errors
from calib.geometry.first_guess import install
from calib.geometry.fit import polish_frames, without_corrections
from calib.geometry.installation import Installation
from calib.geometry.observation import predict, prepare
from calib.geometry.uncertainty.error_model import ErrorModel
from calib.geometry.weighing import Settings
from calib.procedure.findings import Verdict, lines_of
from calib.procedure.kinematic_stage.comparison import (
    INTERVAL,
    MARGIN,
    Comparison,
    compare,
    compare_unseen,
    gravity_of,
    interval_cells,
)
from calib.procedure.kinematic_stage.inputs import Inputs
from calib.procedure.kinematic_stage.metrics import Findings, ValidationMetrics
from calib.procedure.kinematic_stage.settings import FitSettings
from calib.procedure.kinematic_stage.verdict import judge
from calib.robot.chain import Chain
from calib.transforms import invert

ELSEWHERE = 20.0  # nominal errors this many times the fit's: the instrument must have stood elsewhere (our choice)
OUTLIER_SIGMAS = 8.0  # our choice
ARM = {"urdf": "URDF alone", "corrections": "with joint corrections"}
PLACES = tuple(
    f"{name} [{unit}]"
    for head, unit in (("", "m"), ("to_nominal_", "mm"), ("to_calibrated_", "mm"))
    for name in (f"{head}x", f"{head}y", f"{head}z")
)


@dataclass(frozen=True, eq=False)
class Arms:
    """The nominal and the calibrated installation, frames fitted to the fit's rows, and the best rigid geometry.

    With the error model of the calibrated one, where there is one.
    """

    nominal: Installation
    calibrated: Installation
    rigid: Chain
    expected: ErrorModel | None = None


@dataclass(frozen=True, eq=False)
class Assessment:
    """Both arms on the same rows, and what that comes to.

    Attributes:
        fit: on the fit's rows.
        validation: on unseen rows, by file name.
        verdict: on what is to be delivered, with its reason.
        noticed: findings on the fit and on the unseen rows, worst first.
        notes: what the reading of the files noticed, as text.
        deliverables: the verdict on each deliverable that there is (`DELIVERABLES`).
        deliverable: which of them `verdict` is about.
    """

    fit: Comparison
    validation: Mapping[str, Comparison]
    verdict: Verdict
    noticed: tuple[Finding, ...]
    notes: tuple[str, ...]
    deliverables: Mapping[str, Verdict]
    deliverable: str

    @property
    def warnings(self) -> tuple[str, ...]:
        """What a user should know, worst first."""
        return tuple(dict.fromkeys((*lines_of(self.noticed), *self.notes)))

    @property
    def record(self) -> ValidationMetrics:
        """The unseen rows, the verdict and the warnings as ``metrics.json`` holds them."""
        return ValidationMetrics(
            validation={name: comparison.record() for name, comparison in self.validation.items()},
            verdict=self.verdict.level,
            reason=self.verdict.reason,
            code=self.verdict.code,
            advice=self.verdict.advice,
            warnings=self.warnings,
            noticed=self.noticed,
            deliverables=self.deliverables,
            deliverable=self.deliverable,
        )


def assess(arms: Arms, inputs: Inputs, findings: Findings, settings: Settings, wanted: FitSettings) -> Assessment:
    """Compare both arms on fitted and on unseen rows, and judge.

    Args:
        arms: what is compared.
        inputs: the rows.
        findings: what the fit says of itself.
        settings: of the fit, as asked for; the loss is the one that the fit chose.
        wanted: the model asked for, tolerance, deliverable, and the seed of the pairs whose distances are compared.
    """
    both, settings = (arms.nominal, arms.calibrated), settings.combine(loss=findings.loss or settings.loss)
    torques = [gravity_of(inputs.chain, block) for block in inputs.fit]
    alone = without_corrections(arms.calibrated, arms.rigid, inputs.fit, settings)
    fitted = compare(*both, inputs.fit, torques, "fitted on these rows", False, wanted.seed, alone=alone)
    validation = {
        name: compare_unseen(
            *both, unseen, lambda b: gravity_of(inputs.chain, b), settings, wanted.seed, alone, arms.expected
        )
        for name, unseen in inputs.unseen.items()
    }
    judged = judge_deliverables(fitted, validation, findings, wanted)
    chosen = wanted.deliverable if wanted.deliverable in judged else "urdf"
    others = [
        finding("other-deliverable", arm=ARM[other], rms=_worst(validation, findings, other), level=judged[other].level)
        for other in judged.keys() - {chosen}
    ]
    copies = _copies(inputs)
    noticed = (
        *others, *findings.noticed, *([finding("not-unseen", files=copies)] if copies else []),
        *_elsewhere(fitted, validation), *_doubtful(validation), *_unsettled(validation), *_interval_notes(validation),
    )  # fmt: skip
    blocks = (*inputs.fit, *(unseen.block for unseen in inputs.unseen.values()))
    notes = (*inputs.notes, *(note for block in blocks for note in block.notes))
    return Assessment(fitted, validation, judged[chosen], noticed, notes, judged, chosen)


def judge_deliverables(
    fit: Comparison, validation: Mapping[str, Comparison], findings: Findings, wanted: FitSettings
) -> dict[str, Verdict]:
    """Return the verdict on each deliverable: on robot.urdf alone and, where there are any, with joint corrections."""
    common = partial(judge, findings=findings, asked=wanted.model or "auto", tolerance=wanted.tolerance)
    if fit.alone is None:
        return {"urdf": common(fit, validation, cross_validated=findings.cross_validated)}
    bare = {name: each.of_urdf for name, each in validation.items()}
    return {
        "urdf": common(fit.of_urdf, bare, cross_validated=findings.rigid_cross_validated, arm=ARM["urdf"]),
        "corrections": common(fit, validation, cross_validated=findings.cross_validated, arm=ARM["corrections"]),
    }


def _worst(validation: Mapping[str, Comparison], findings: Findings, deliverable: str) -> float:
    """Return the largest rms error of a deliverable on unseen rows; without any, that by cross-validation [m]."""
    alone = deliverable == "urdf"
    sizes = [_rms((each.of_urdf if alone else each).errors[1]) for each in validation.values() if each.proves]
    by_folds = findings.rigid_cross_validated if alone else findings.cross_validated
    return max(sizes, default=np.nan if by_folds is None else by_folds)


def _copies(inputs: Inputs) -> list[str]:
    """Name files given as unseen that hold what was fitted."""
    words = []
    for name, unseen in inputs.unseen.items():
        if unseen.seen:
            own = next((Path(block.file).name for block in inputs.fit if _same_rows(block, unseen.block)), "")
            same = "was fitted on" if own == name else f"is a copy of {own}"
            words.append(f"{name} {same if own else 'repeats rows of the fit'}")
    return words


def _same_rows(one: PoseMeasurements, other: PoseMeasurements) -> bool:
    return np.array_equal(one.q, other.q) and np.array_equal(one.measured, other.measured)


def nominal_arm(inputs: Inputs, settings: Settings) -> Installation:
    """Return the nominal arm, corrections that came with it included, base and tool placement fitted for it."""
    torques = [gravity_of(inputs.chain, block) for block in inputs.fit]
    return polish_frames(install(inputs.chain, inputs.fit, inputs.known), inputs.fit, settings, torques).cell


def _elsewhere(fit: Comparison, validation: Mapping[str, Comparison]) -> list[Finding]:
    """Return validation files whose errors look like another placement of the instrument, not like an arm's."""
    usual = float(np.median(fit.errors[0].main)) if len(fit.errors[0].main) else np.inf
    sizes = {name: float(np.median(found.errors[0].main)) for name, found in validation.items()}
    return [
        finding("validation-elsewhere", file=name, rms=size) for name, size in sizes.items() if size > ELSEWHERE * usual
    ]


def _doubtful(validation: Mapping[str, Comparison]) -> list[Finding]:
    """Return unseen rows whose error is more than `OUTLIER_SIGMAS` times the median: they may be wrong measurements."""
    result = []
    for name, each in validation.items():
        sizes, numbers = each.errors[1].main, [row for block in each.blocks for row in _numbers(block)]
        far = np.flatnonzero(sizes > OUTLIER_SIGMAS * np.median(sizes)) if len(sizes) == len(numbers) else []
        if not len(far):
            continue
        rest = np.delete(sizes, far)
        beyond = None if each.intervals is None else each.intervals.beyond
        outside = 0 if beyond is None or len(beyond) != len(sizes) else int(np.count_nonzero(beyond[far]))
        result.append(
            finding(
                "doubtful-rows", file=name, rows=[f"row {numbers[k]} ({1e3 * sizes[k]:.3g} mm)" for k in far],
                median=np.median(sizes), without=float(np.sqrt(np.mean(rest**2))), outside=outside,
            )
        )  # fmt: skip
    return result


def _interval_notes(validation: Mapping[str, Comparison]) -> list[Finding]:
    """Return how many errors on unseen rows are within the 95 % interval, and where the model extrapolates."""
    result = []
    for name, each in validation.items():
        if (found := each.intervals) is None or not each.settled or each.placed_by is not None:
            continue
        count = len(found.size)
        values = {"covered": found.covered, "errors": count, "median": np.median(found.radius)}
        result.append(finding("interval-coverage", file=name, **values))
        if beyond := int(found.beyond.sum()):
            result.append(finding("outside-fitted-range", file=name, beyond=beyond, poses=count, joints=found.joints))
    return result


def _unsettled(validation: Mapping[str, Comparison]) -> list[Finding]:
    """Return unseen files on which the placement of base and tool did not settle, or took up most of the errors."""
    result = []
    for name, each in validation.items():
        if not each.settled:
            result.append(finding("placement-unsettled", file=name))
        elif each.placed_by is not None:
            measured, fitted = each.placed_by
            result.append(
                finding("placement-takes-all", file=name, measured=measured, fitted=fitted, wanted=MARGIN * fitted)
            )
    return result


def write_errors(path: Path, chain: Chain, validation: Mapping[str, Comparison]) -> None:
    """Write the errors of both arms at every unseen row; where positions were measured, with where and whither.

    Then ``x y z`` is where the target was seen, ``to_nominal`` and ``to_calibrated`` lead from there to where each arm
    puts it, all in the calibrated arm's base. Behind them `INTERVAL`, as in ``residuals.csv``.
    """
    rows: list[list[object]] = []
    for name, each in validation.items():
        q = np.concatenate([block.q for block in each.blocks])
        numbers = [row for block in each.blocks for row in _numbers(block)]
        sizes = [found.main for found in each.errors]
        if len(sizes[0]) == len(q):
            places = np.concatenate([_places(each, number) for number in range(len(each.blocks))])
            stated = interval_cells(each, len(q))
            rows += [
                [name, number, *map(float, joints), 1e3 * float(a), 1e3 * float(b), *map(_cell, place), *interval]
                for number, joints, a, b, place, interval in zip(numbers, q, *sizes, places, stated)
            ]
    joints = [f"{joint.name} [{joint.unit}]" for joint in chain.joints]
    files.write_table(path, ["file", "row", *joints, "nominal [mm]", "calibrated [mm]", *PLACES, *INTERVAL], rows)


def _places(found: Comparison, number: int) -> np.ndarray:
    """Return seen position [m] and the ways from there to both arms' [mm] of one block (m, 9); NaN without any."""
    block, torque = found.blocks[number], [found.torques[number]]
    if not isinstance(block, Positions):
        return np.full((len(block), 9), np.nan)
    ready = [prepare(cell, [block], torque)[0] for cell in found.cells]
    base = invert(found.cells[1].stations[ready[1].station])
    ways = [1e3 * (predict(cell, one).point.T - block.position) for cell, one in zip(found.cells, ready)]
    turn = base[:3, :3].T
    return np.hstack([block.position @ turn + base[:3, 3], *(way @ turn for way in ways)])


def _cell(value: float) -> float | None:
    return None if np.isnan(value) else float(value)


def _numbers(block: PoseMeasurements) -> list[int]:
    return [int(row) for row in block.rows]


def _rms(found: Errors) -> float:
    return float(np.sqrt(np.mean(found.main**2))) if len(found.main) else 0.0
