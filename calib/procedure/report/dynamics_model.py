"""The identified model in words, and the friction models tried: part of the report section on the dynamics."""

import numpy as np

from calib.identification.friction.ripple import RippleWaves
from calib.procedure.dynamic_stage.metrics import ModelMetrics
from calib.procedure.report import page


def friction_table(metrics: ModelMetrics) -> page.ReportTable:
    """Return the table of the tried friction models with their errors on held-out time, in total and by torque row.

    Args:
        metrics: metrics of the identification.
    """
    count = max(len(step.joints_percent) for step in metrics.ladder)
    joints = [str(j + 1) for j in range(count)]
    header = ["friction", "p", "total", *joints, "kept at joints"]
    rows = []
    strong = set()
    for k, step in enumerate(metrics.ladder):
        shares = [_rounded(share, 1) for share in step.joints_percent]
        shares += [""] * (count - len(shares))
        remark = ", ".join(map(str, step.kept_at_joints)) or step.note
        total = _rounded(step.cross_validated_percent, 2)
        rows.append([step.model, str(step.parameters), total, *shares, remark])
        if step.kept:
            strong.add(k)
    title = "Ladder of friction models: relative error on held-out time [%]"
    numbers = range(1, len(header) - 1)
    return page.ReportTable(title, header, rows, f"Chosen: {metrics.friction}.", frozenset(strong), list(numbers))


def _rounded(share: float, digits: int) -> str:
    return f"{share:.{digits}f}" if np.isfinite(share) else "–"


def model_sentences(metrics: ModelMetrics) -> list[str]:
    """Return sentences on the model: ripple, couplings, method, number of parameters, and eliminated parameters.

    Args:
        metrics: metrics of the identification.
    """
    lines = [_ripple_sentence(ripple) for ripple in metrics.ripple]
    lines += _coupling_sentences(metrics)
    lines.append(f"method {metrics.method}: assumes that {metrics.method_assumes}")

    count, columns = metrics.parameters, metrics.counts
    base = count.standard - columns.without_effect - columns.regrouped
    raw = _condition(metrics.condition_number.raw)
    normalised = _condition(metrics.condition_number.normalised)
    lines.append(
        f"{count.standard} standard parameters: {columns.without_effect} without effect, {columns.regrouped} "
        f"regrouped, {base} base; {count.base - base} additional friction parameters; "
        f"condition {raw}, with unit columns {normalised}"
    )
    if metrics.elimination or count.essential < count.base:
        removed = []
        for step in metrics.elimination:
            rsd = f" ({_rsd(step.rsd)})" if np.isfinite(step.rsd) else ""
            removed.append(f"{step.name}{rsd}")
        names = ", ".join(removed) or "none"
        lines.append(f"{count.essential} essential parameters; removed, with their RSD: {names}")
    return lines


def _ripple_sentence(ripple: RippleWaves) -> str:
    """Return a sentence on a joint's torque ripple: its orders, and the share of the residual that it explains."""
    orders = []
    for wave in ripple.waves:
        gear = "" if wave.gear == ripple.joint else f" of joint {wave.gear}"
        orders.append(f"{wave.order_per_turn:g}{gear}")
    return (
        f"ripple at joint {ripple.joint}, orders {', '.join(orders)} per turn: explains "
        f"{100 * ripple.explained_share_on_unseen_blocks:.0f} % of the fast residual's power on held-out parts of "
        "the motion; "
        "not included in the covariance"
    )


def _coupling_sentences(metrics: ModelMetrics) -> list[str]:
    """Return sentences on how much each coupling term between two joints lowers the errors of these joints.

    The physical cause of a coupling is not stated, since nobody measured it in the drives.

    Args:
        metrics: metrics of the identification.
    """
    lines: list[str] = []
    if not metrics.ladder:
        return lines
    before = metrics.ladder[0]
    for step in metrics.ladder:
        if step.model == "+ coupling":
            # the coupled joints are listed pair by pair
            joints = step.kept_at_joints
            for pair in zip(joints[::2], joints[1::2]):
                errors_before = " and ".join(f"{before.joints_percent[joint - 1]:.3g}" for joint in pair)
                errors_after = " and ".join(f"{step.joints_percent[joint - 1]:.3g}" for joint in pair)
                lines.append(
                    f"a coupling term between joints {pair[0]} and {pair[1]} lowers their errors on held-out rows "
                    f"from {errors_before} % to {errors_after} %"
                )
        if step.kept:
            before = step
    return lines


def _condition(number: float) -> str:
    return f"{number:.0f}" if np.isfinite(number) else "infinite"


def _rsd(percent: float) -> str:
    """Return a relative standard deviation [%] as text; "above 1000 %" for larger values."""
    return f"{percent:.0f} %" if percent < 1000.0 else "above 1000 %"
