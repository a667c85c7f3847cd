"""May one trust the calibrated arm? One function, its rules stated; all thresholds are our choice."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calib.procedure.comparing import Comparison

WORSE = 1.01  # calibrated over nominal rms on the unseen from which on it is worse, not only no better
GAIN = 0.10  # a smaller gain in rms on the unseen is no gain worth a new robot file
TRANSFER = 3.0  # unseen errors this many times the fit's own: the fit does not transfer
OUTLIERS = 0.05  # more rows than this share that do not fit: something is wrong with the measurements or the model


@dataclass(frozen=True)
class Verdict:
    """``pass``, ``marginal`` or ``fail``, and why, in one sentence."""

    level: str
    reason: str


def judge(
    fit: Comparison,
    validation: Mapping[str, Comparison],
    *,
    model: str,
    asked: str,
    cross_validated: float | None,
    outlier_share: float,
    unexplained: str = "",
) -> Verdict:
    """Judge a calibration by the rows it has not seen.

    Rules, the first that holds:

    1. only frames were asked for: pass, with nothing claimed of the arm;
    2. on any unseen file the calibrated arm is worse than the nominal one: fail;
    3. no unseen rows and no cross-validation: marginal;
    4. no rigid geometry explains the measurements (`calib.procedure.diagnosis.plateau`), and what else the chosen model
       holds does not explain them either (`remains`): marginal at best;
    5. the gain on the unseen is below `GAIN`: marginal;
    6. unseen errors above `TRANSFER` times the fit's own: marginal;
    7. more than `OUTLIERS` of the rows do not fit: marginal;
    8. else pass.

    Args:
        fit: both arms on the fit's rows.
        validation: both arms on other rows.
        model, asked: the model chosen, and the one asked for.
        cross_validated: error of the chosen model on rows left out [m], where it was computed.
        outlier_share: of the fit's rows.
        unexplained: the sentence of rule 4, or empty.
    """
    proofs = {name: comparison for name, comparison in validation.items() if comparison.proves}
    own = _rms(fit.errors[1].main)
    if model == "frames":
        if asked == "frames":
            return Verdict("pass", "only base and tool placement were asked for; the arm is as it was")
        return Verdict("fail", "no model of the arm predicts unseen poses better than the nominal one")
    for name, comparison in proofs.items():
        before, after = (_rms(found.main) for found in comparison.errors)
        if after > WORSE * before:
            return Verdict(
                "fail", f"on {name} the calibrated arm is worse than the nominal one: {_both(before, after)}"
            )
    if not proofs and cross_validated is None:
        return Verdict(
            "marginal", "there are no unseen poses: errors on fitted poses say little of others; --holdout 0.25"
        )
    if not proofs:
        before, after, where = _rms(fit.errors[0].main), float(cross_validated or 0.0), "by cross-validation only"
        if after > WORSE * before:
            return Verdict("fail", f"{where}, the calibrated arm is worse than the nominal one: {_both(before, after)}")
    else:
        name = max(proofs, key=lambda key: _rms(proofs[key].errors[1].main))
        before, after = (_rms(found.main) for found in proofs[name].errors)
        where = f"on {name}, unseen"
    both = _both(before, after)
    if unexplained:
        return Verdict("marginal", f"{unexplained}; {where}: {both}")
    if after > (1.0 - GAIN) * before:
        return Verdict("marginal", f"{where}, the gain is small: {both}; the arm may be calibrated already")
    if after > TRANSFER * own:
        return Verdict("marginal", f"{where}, errors are {after / own:.1f} times those on the fitted poses: {both}")
    if outlier_share > OUTLIERS:
        return Verdict(
            "marginal", f"{where}: {both}; but {100 * outlier_share:.0f} % of the fitted rows do not fit (outliers)"
        )
    return Verdict("pass", f"{where}: {both}")


def _rms(sizes: np.ndarray) -> float:
    return float(np.sqrt(np.mean(sizes**2))) if len(sizes) else 0.0


def _both(before: float, after: float) -> str:
    return f"rms {1e3 * before:.3f} mm nominal, {1e3 * after:.3f} mm calibrated"
