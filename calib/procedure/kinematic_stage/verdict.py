"""May one trust the calibrated arm? The rules' limits and sentences stand in the catalogue, chapter 4."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib.errors import Finding, finding
from calib.procedure.findings import Verdict, catalogue, level_of, sentence
from calib.procedure.kinematic_stage.comparison import Comparison
from calib.procedure.kinematic_stage.metrics import Findings
from calib.procedure.kinematic_stage.plausibility import FLOOR, TOO_GOOD

RIGID = ("rigid-misfit", "gross-rows", "earlier-misfit")  # no rigid geometry explains the measurements


@dataclass(frozen=True)
class _Proof:
    """What the arms are judged by: rms errors [m], and on which rows."""

    before: float
    after: float
    where: str
    rows: Comparison | None = None

    @property
    def left(self) -> float:
        """Share of the nominal arm's error that is left."""
        return self.after / max(self.before, 1e-300)


def judge(
    fit: Comparison,
    validation: Mapping[str, Comparison],
    findings: Findings,
    *,
    asked: str = "auto",
    tolerance: float | None = None,
    cross_validated: float | None = None,
    arm: str = "",
) -> Verdict:
    """Judge a calibration by the rows it has not seen; without unseen files, by cross-validation.

    Rules, the first group that says something; inside a group the worst finding decides:

    1. ``placed-elsewhere``, ``far-off``; ``orientations-off``; ``above-tolerance``;
    2. ``frames-only``, where no more was asked for;
    3. frames were chosen: no model of the arm is better than the nominal one. ``nothing-to-gain`` (pass) where what
       remains is below `FLOOR` of the reach, ``transfer-untested`` where stations could not be left out as a whole,
       else ``no-better-model``. With any model a pass where the nominal arm leaves less than any instrument
       (`TOO_GOOD`);
    4. ``worse-than-nominal``; by cross-validation alone, where both leave less than `FLOOR` of the reach,
       ``keep-nominal``, since the nominal arm may have been fitted to these very rows;
    5. ``no-unseen-poses``;
    6. ``rigid-misfit`` or ``gross-rows`` of the fit, ``refuted``, ``no-transfer``, ``intervals-too-narrow``,
       ``small-gain``, ``many-outliers``; none of them: pass.

    The fit's other findings, those of `calib.procedure.kinematic_stage.plausibility`, count in every group.

    Args:
        fit: both arms on the fit's rows.
        validation: both arms on other rows.
        findings: what the fit says of itself.
        asked: the model asked for.
        tolerance: largest rms on unseen poses that is good enough [m]; None where none was given.
        cross_validated: error of what is judged on held-out rows [m]; None where it was not computed.
        arm: what is judged, in a word or two, where there are several deliverables.
    """
    proofs = {name: comparison for name, comparison in validation.items() if comparison.proves}
    own, nominal = (_rms(fit.errors[k].main) for k in (1, 0))
    if findings.nominal_cross_validated is not None:
        nominal = findings.nominal_cross_validated
    found = [
        _Proof(_rms(rows.errors[0].main), _rms(rows.errors[1].main), f"on {name}, unseen", rows)
        for name, rows in proofs.items()
    ]
    if not found and cross_validated is not None:
        found = [_Proof(nominal, cross_validated, "by cross-validation only")]
    worst = max(found, key=lambda proof: proof.after, default=None)
    others = [one for one in findings.noticed if one.code not in RIGID]
    for group in (
        [*_wrong(found, findings.reach), *_turned({"the fitted poses": fit, **proofs}), *_coarse(found, tolerance)],
        [finding("frames-only", rms=own)] if findings.model == asked == "frames" else [],
        _nothing_gained(found, findings),
        _worse(found, bool(proofs), findings.reach),
    ):
        if group:
            return _verdict(group, others, worst, arm)
    if worst is None:
        return Verdict.of("", [finding("no-unseen-poses"), *others])
    rules = [*findings.noticed, *_rules(worst, own, cross_validated, proofs, findings)]
    verdict = Verdict.of(_figures(worst, arm), rules)
    return Verdict("pass", _figures(worst, arm, tolerance)) if verdict.level == "pass" else verdict


def _verdict(group: Sequence[Finding], others: Sequence[Finding], worst: _Proof | None, arm: str) -> Verdict:
    """Return the verdict of a group of rules that decides; what only notes something stands for the figures."""
    if level_of(group[0]) != "note":
        return Verdict.of("" if worst is None else _figures(worst, arm), [*others, *group])
    return Verdict.of(sentence(group[0]), others)


def _figures(worst: _Proof, arm: str, tolerance: float | None = None) -> str:
    values = {"after": worst.after, "before": worst.before, "where": worst.where, "arm": arm, "tolerance": tolerance}
    return sentence(finding("errors", **values))


def _noticed(found: Iterator[Finding]) -> list[Finding]:
    return [one for one in found if level_of(one)]


def _wrong(found: Sequence[_Proof], reach: float) -> list[Finding]:
    """Return files on which both arms are far off: the instrument stood elsewhere, or it is another robot."""
    files = ((proof, proof.rows) for proof in found if proof.rows is not None)
    shares = ((min(proof.before, proof.after) / reach, rows.shares_frames) for proof, rows in files)
    return _noticed(finding("placed-elsewhere" if shares_ else "far-off", share=share) for share, shares_ in shares)


def _turned(sets: Mapping[str, Comparison]) -> list[Finding]:
    angles = ((name, rows.errors[1].orientation) for name, rows in sets.items())
    return _noticed(
        finding("orientations-off", where=name, angle=_rms(angle)) for name, angle in angles if angle is not None
    )


def _coarse(found: Sequence[_Proof], tolerance: float | None) -> list[Finding]:
    if tolerance is None:
        return []
    return _noticed(finding("above-tolerance", tolerance=tolerance, times=one.after / tolerance) for one in found)


def _nothing_gained(found: Sequence[_Proof], findings: Findings) -> list[Finding]:
    proof = max(found, key=lambda one: one.before, default=_Proof(np.inf, np.inf, ""))
    nothing = [finding("nothing-to-gain", before=proof.before, where=proof.where)]
    if findings.model != "frames":
        return nothing if proof.before < TOO_GOOD else []
    if not proof.before <= FLOOR * findings.reach < np.inf:
        return [finding("no-better-model")]
    return [finding("transfer-untested", stations=findings.blind)] if findings.blind else nothing


def _worse(found: Sequence[_Proof], files: bool, reach: float) -> list[Finding]:
    worse = _noticed(finding("worse-than-nominal", times=proof.left) for proof in found)
    if worse and not files and found[0].after <= FLOOR * reach < np.inf:
        return [finding("keep-nominal")]
    return worse


def _rules(
    worst: _Proof, own: float, cross_validated: float | None, proofs: Mapping[str, Comparison], findings: Findings
) -> Iterator[Finding]:
    """Yield the findings of the last group, worst first; those without a level count for nothing."""
    times = worst.after / max(own, 1e-300)
    shared = any(rows.shares_frames for rows in proofs.values())
    remedy = catalogue()["placed-elsewhere"].advice if shared else ""
    if proofs and cross_validated is not None and not any(one.code in RIGID for one in findings.noticed):
        promised = worst.after / max(cross_validated, 1e-300)
        yield finding("refuted", times=times, promised=promised, left=worst.left, remedy=remedy)
    yield finding("no-transfer", times=times, remedy=remedy)
    for name, rows in proofs.items():
        if (held := rows.intervals) is not None:
            chance = 3.0 * float(np.sqrt(0.95 * 0.05 / len(held.size)))
            yield finding(
                "intervals-too-narrow", where=name, errors=len(held.size), covered=held.covered,
                median=np.median(held.radius), missing=0.95 - chance - held.covered,
            )  # fmt: skip
    yield finding("small-gain", left=worst.left)
    yield finding("many-outliers", share=findings.outlier_share)


def _rms(sizes: np.ndarray) -> float:
    return float(np.sqrt(np.mean(sizes**2))) if len(sizes) else 0.0
