"""May one trust the calibrated arm? One function, its rules stated; all thresholds are our choice."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib.procedure.findings import Verdict
from calib.procedure.kinematic_stage.comparison import Comparison
from calib.procedure.kinematic_stage.remarks import FLOOR, TOO_GOOD

WORSE = 1.01  # calibrated over nominal rms on the unseen from which on it is worse, not only no better
GAIN = 0.10  # a smaller gain in rms on the unseen is no gain worth a new robot file
HOLDS, FEWEST = 0.93, 20  # least coverage of the 95 % intervals, beyond chance; errors it takes to say so
TRANSFER = 3.0  # unseen errors this many times the fit's own: the fit does not transfer
REFUTED = 5.0  # unseen errors this many times what rows left out promised, and no gain: the calibration is refuted
OUTLIERS = 0.05  # more rows than this share that do not fit: something is wrong with the measurements or the model
TURNED = 5.0  # rms of the calibrated arm's orientations [deg] that no calibrated arm has
ELSEWHERE = 0.10  # of the reach: errors of both arms that say where the instrument stood, and nothing of the arms
OWN_FRAMES = 'refit their frames (--refit-frames; in a session: validation_frames = "own" in session.toml)'


@dataclass(frozen=True)
class _Proof:
    """What the arms are judged by: rms errors [m], and where they were found, in words."""

    before: float
    after: float
    where: str
    arm: str

    @property
    def both(self) -> str:
        return f"rms {1e3 * self.before:.3f} mm nominal, {1e3 * self.after:.3f} mm {self.arm}"

    @property
    def small_gain(self) -> bool:
        return self.after > (1.0 - GAIN) * self.before


def judge(
    fit: Comparison,
    validation: Mapping[str, Comparison],
    *,
    model: str,
    asked: str,
    cross_validated: float | None,
    outlier_share: float,
    unexplained: str = "",
    nominal_cross_validated: float | None = None,
    reach: float = np.inf,
    tolerance: float | None = None,
    blind: Sequence[str] = (),
    arm: str = "calibrated",
) -> Verdict:
    """Judge a calibration by the rows it has not seen.

    Rules, the first that holds:

    1. on some unseen file both arms are off by more than `ELSEWHERE` of the reach: not judged, which is a fail, since
       nothing is proved;
    2. the calibrated arm's orientations are off by more than `TURNED` on some unseen file, or on the fitted rows: fail;
    3. the tolerance, where one was given, is exceeded on some unseen file: fail;
    4. only frames were asked for: pass, with nothing claimed of the arm;
    5. frames were chosen, so that no model of the arm is better than the nominal one: pass where what remains is below
       `calib.procedure.kinematic_stage.remarks.FLOOR` of the reach (there is nothing to gain), else fail; where not
       every station could be left out as a whole, the choice itself is in doubt: marginal in place of pass. With any
       model, pass where the nominal arm leaves less than any instrument (`TOO_GOOD`);
    6. on some unseen file the calibrated arm is worse than the nominal one: fail. By cross-validation alone, where both
       leave less than `FLOOR` of the reach: marginal, since the nominal arm may have been fitted to these very rows;
    7. no unseen rows and no cross-validation: marginal;
    8. no rigid geometry explains the measurements (`calib.procedure.kinematic_stage.remarks.plateau`), and what else
       the chosen model holds does not explain them either (`remains`): marginal at best;
    9. unseen errors above `TRANSFER` times the fit's own: marginal; fail where they are above `REFUTED` times those of
       cross-validation, too, and the gain is below `GAIN`;
    10. the 95 % intervals that the fit states hold less than `HOLDS` of the errors on some unseen file, beyond chance:
        marginal;
    11. the gain on the unseen is below `GAIN`: marginal;
    12. more than `OUTLIERS` of the rows do not fit: marginal;
    13. else pass.

    What cannot be of this arm holds the verdict down afterwards (`calib.procedure.kinematic_stage.plausibility`).
    Without unseen files, both arms are judged by cross-validation.

    Args:
        fit: both arms on the fit's rows.
        validation: both arms on other rows.
        model, asked: the model chosen, and the one asked for.
        cross_validated: error of the chosen model on rows left out [m], where it was computed.
        outlier_share: of the fit's rows.
        unexplained: the sentence of rule 8, or empty.
        nominal_cross_validated: error of the nominal arm on rows left out [m]; by default its error on the fit's rows.
        reach: of the arm [m].
        tolerance: largest rms on unseen poses that is good enough [m]; None where none was given.
        blind: stations that could not be left out as a whole.
        arm: what is judged, in a word or two.
    """
    proofs = {name: comparison for name, comparison in validation.items() if comparison.proves}
    own = _rms(fit.errors[1].main)
    nominal = _rms(fit.errors[0].main) if nominal_cross_validated is None else nominal_cross_validated
    found = [*_of_files(proofs, arm)]
    if not found and cross_validated is not None:
        found = [_Proof(nominal, cross_validated, "by cross-validation only", arm)]
    for verdict in (
        _elsewhere(proofs, reach),
        _turned({"the fitted poses": fit, **proofs}),
        _too_coarse(found, tolerance),
        _frames_asked(model, asked, own),
        _nothing_gained(found, model, reach, blind),
        _worse(found, bool(proofs), reach),
    ):
        if verdict is not None:
            return verdict
    if not found:
        return Verdict(
            "marginal",
            "there are no unseen poses: errors on fitted poses say little of others; hold some out (--holdout 0.25)",
        )
    worst = max(found, key=lambda proof: proof.after)
    if unexplained:
        return Verdict("marginal", f"{unexplained}; {worst.where}: {worst.both}")
    broken = _intervals_broken(proofs)
    if worst.after > TRANSFER * own:
        return _not_transferred(worst, own, cross_validated, proofs, broken)
    if broken:
        return Verdict("marginal", f"{worst.where}: {worst.both}; {broken}")
    if worst.small_gain:
        return Verdict("marginal", f"{worst.where}, the gain is small: {worst.both}; the arm may be calibrated already")
    if outlier_share > OUTLIERS:
        share = f"{100 * outlier_share:.0f} % of the fitted rows do not fit (outliers)"
        return Verdict("marginal", f"{worst.where}: {worst.both}; but {share}")
    kept = "" if tolerance is None else f", within the tolerance of {1e3 * tolerance:g} mm"
    return Verdict("pass", f"{worst.where}: {worst.both}{kept}")


def _not_transferred(
    worst: _Proof, own: float, cross_validated: float | None, proofs: Mapping[str, Comparison], broken: str
) -> Verdict:
    """Judge unseen errors far above those of the fit's own rows, by rule 9."""
    words = f"errors are {worst.after / own:.1f} times those on the fitted poses"
    advice = f"; if the instrument or tool stood elsewhere, {OWN_FRAMES}" if _shares_frames(proofs) else ""
    level = "marginal"
    if proofs and worst.small_gain and cross_validated is not None and worst.after > REFUTED * cross_validated:
        level = "fail"
        words = f"hardly any gain, and {words}; rows left out promised {1e3 * cross_validated:.3f} mm"
    also = f"; {broken}" if broken else ""
    return Verdict(level, f"{worst.where}, {words}: {worst.both}{also}{advice}")


def _intervals_broken(proofs: Mapping[str, Comparison]) -> str:
    """Say on which unseen file errors are larger than the fit states, beyond chance; empty for none."""
    for name, comparison in proofs.items():
        if (found := comparison.intervals) is None or len(found.size) < FEWEST:
            continue
        chance = 3.0 * np.sqrt(0.95 * 0.05 / len(found.size))
        if found.covered < HOLDS - chance:
            return (
                f"its 95 % intervals do not hold: {100 * found.covered:.0f} % of {len(found.size)} errors on {name} "
                f"are within them (median ± {1e3 * np.median(found.radius):.3f} mm); measure poses like these, too"
            )
    return ""


def _of_files(proofs: Mapping[str, Comparison], arm: str) -> Iterator[_Proof]:
    for name, comparison in proofs.items():
        before, after = (_rms(found.main) for found in comparison.errors)
        yield _Proof(before, after, f"on {name}, unseen", arm)


def _turned(sets: Mapping[str, Comparison]) -> Verdict | None:
    for name, comparison in sets.items():
        angles = comparison.errors[1].orientation
        if angles is not None and (size := float(np.degrees(_rms(angles)))) > TURNED:
            return Verdict(
                "fail",
                f"on {name} the arm's orientations are off by {size:.0f}° rms: are quaternions x y z w, do angles mean "
                "what euler says, is it the target's orientation seen from the instrument and not the reverse, did the "
                "target turn in the hand? kind = 'position' in the options fits positions alone",
            )
    return None


def _elsewhere(proofs: Mapping[str, Comparison], reach: float) -> Verdict | None:
    for name, comparison in proofs.items():
        before, after = (_rms(found.main) for found in comparison.errors)
        if min(before, after) <= ELSEWHERE * reach:
            continue
        found = f"{name} is not judged: rms {1e3 * before:.0f} mm nominal, {1e3 * after:.0f} mm calibrated"
        if comparison.shares_frames:
            return Verdict("fail", f"{found}: the instrument or tool stood elsewhere; {OWN_FRAMES}")
        return Verdict(
            "fail",
            f"{found}, wherever instrument and tool are placed: is it this robot, are units, joint order and signs "
            "right, and did instrument and tool stay where they were (else one file each, stations 'each')?",
        )
    return None


def _frames_asked(model: str, asked: str, left: float) -> Verdict | None:
    if model == "frames" and asked == "frames":
        words = "only base and tool placement were asked for; the arm is as it was"
        return Verdict("pass", f"{words}, {1e3 * left:.3f} mm rms remain")
    return None


def _too_coarse(found: list[_Proof], tolerance: float | None) -> Verdict | None:
    if tolerance is None:
        return None
    for proof in found:
        if proof.after > tolerance:
            return Verdict("fail", f"{proof.where}: {proof.both}, above the tolerance of {1e3 * tolerance:g} mm")
    return None


def _nothing_gained(found: list[_Proof], model: str, reach: float, blind: Sequence[str]) -> Verdict | None:
    worst = max((proof.before for proof in found), default=np.inf)
    if model != "frames":
        words = f"nothing to gain: the nominal arm leaves {1e6 * worst:.2g} µm rms on unseen poses"
        return Verdict("pass", words) if worst < TOO_GOOD else None
    if blind and worst <= FLOOR * reach < np.inf:
        return Verdict(
            "marginal",
            f"no model of the arm was found better than the nominal one ({1e3 * worst:.3f} mm rms), but "
            f"{', '.join(blind)} could be left out by regions only: the other rows do not tell where the tool would be "
            "there, so that nothing says what transfers; measure poses that turn about several axes from one station",
        )
    if worst <= FLOOR * reach < np.inf:
        return Verdict(
            "pass",
            "nothing to gain: the nominal arm predicts unseen poses as well as any fitted one, "
            f"{1e3 * worst:.3f} mm rms",
        )
    return Verdict("fail", "no model of the arm predicts unseen poses better than the nominal one")


def _worse(found: list[_Proof], files: bool, reach: float) -> Verdict | None:
    for proof in found:
        if proof.after <= WORSE * proof.before:
            continue
        if not files and proof.after <= FLOOR * reach < np.inf:
            return Verdict(
                "marginal",
                f"{proof.where}, there is nothing to gain: {proof.both}; keep the nominal robot, unless it was fitted "
                "to these very rows and unseen ones say otherwise",
            )
        return Verdict("fail", f"{proof.where}, the calibrated arm is worse than the nominal one: {proof.both}")
    return None


def _shares_frames(proofs: Mapping[str, Comparison]) -> bool:
    return any(comparison.shares_frames for comparison in proofs.values())


def _rms(sizes: np.ndarray) -> float:
    return float(np.sqrt(np.mean(sizes**2))) if len(sizes) else 0.0
