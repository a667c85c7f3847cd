"""The folder of an identification: written whole, beside its place, then moved there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from calib import files
from calib.dynamics.base import expressions
from calib.errors import UsageError
from calib.folders import check_folder, write_staged
from calib.identification.cases import Case
from calib.identification.gains import DriveGains
from calib.identification.methods.least_squares import ASSUMES
from calib.identification.model_file import in_unit, to_table
from calib.identification.possible.information import information
from calib.identification.scores import Score, TorqueErrors
from calib.procedure.dynamic_stage import geometry_tables
from calib.procedure.dynamic_stage.identify import IdentificationOutcome
from calib.procedure.dynamic_stage.loop_tables import loop_table, write_instrumental
from calib.procedure.dynamic_stage.tracking import tracking_table
from calib.procedure.dynamic_stage.verdict import resting_parameters
from calib.robot import calibrated

OURS = (
    calibrated.ROBOT, "dynamics.json", "estimate.csv", "covariance.csv", "information.csv", "instrumental.csv",
    "metrics.json", "drive_gains.csv",
    "torques_1.csv", calibrated.COVARIANCE, geometry_tables.EFFECTS, geometry_tables.SENSITIVITY,
    geometry_tables.GEOMETRIES,
)  # fmt: skip
"""Files of an earlier identification that a new one replaces; besides plots, ``plot_*.png``."""
TORQUE_RATE = 100.0  # of torques_1.csv [Hz]
OFF = 1e-9  # σ of a friction term below which it is the ridge's floor, not a measurement [N m] (our choice)
HEADER = ("name", "expression", "unit", "value", "sigma", "rsd", "essential", "sigma_torque", "sigma_geometry")


def check_target(out: Path, source: Path | None = None) -> None:
    """Refuse, before any work is done, a folder that cannot be written or whose files are not ours to replace."""
    check_folder(out)
    if source is not None and source.resolve().parent == out.resolve():
        raise UsageError(f"{out} holds the robot that is to be identified; choose another folder for --out")
    present = [name for name in OURS if (out / name).exists()]
    if present and not ((out / "metrics.json").exists() and (out / "dynamics.json").exists()):
        raise UsageError(f"{out} holds {', '.join(present)} which no earlier identification left there; choose another")


def write_folder(
    outcome: IdentificationOutcome, out: Path, plots: Callable[[IdentificationOutcome, Path], None] | None = None
) -> Path:
    """Write all files of an identification, all or none; see `calib.folders`."""
    check_target(out, outcome.inputs.source)

    def write(folder: Path) -> None:
        _write_all(outcome, folder)
        if plots is not None:
            plots(outcome, folder)

    return write_staged(out, OURS, write)


def _write_all(outcome: IdentificationOutcome, folder: Path) -> None:
    inputs, found = outcome.inputs, outcome.found
    robot = replace(inputs.robot, nominal=inputs.robot.nominal or inputs.chain, source=str(inputs.source))
    calibrated.write(folder, robot, comment=f"identified from {inputs.source}")
    files.write_table(folder / "estimate.csv", HEADER, estimate_rows(outcome))
    estimate = found.fitted.estimate
    covariance = estimate.covariance if outcome.carried is None else outcome.carried.covariance
    rows = ([name, *map(float, row)] for name, row in zip(found.names, covariance))
    files.write_table(folder / "covariance.csv", ("name", *found.names), rows)
    geometry_tables.write(outcome, folder)
    write_instrumental(found.bias, folder)
    if found.prior is not None:  # else estimate and covariance say it all
        triangle = information(found)
        files.write_table(folder / "information.csv", (*found.names, "target"), triangle.tolist())
    first = (*inputs.unseen, *inputs.cases)[0]
    write_torques(first, outcome.predictions[first.name], folder / "torques_1.csv")
    table = to_table(found.dynamics, found.base, inputs.unit) | {"drive_gains": gain_table(inputs.gains, inputs.unit)}
    files.write_json(folder / "dynamics.json", table)
    if inputs.gains is not None:
        columns = (inputs.chain.joint_names, inputs.gains.gains.tolist(), inputs.gains.sigma.tolist())
        files.write_table(folder / "drive_gains.csv", ("joint", f"gain [{inputs.unit} per A]", "sigma"), zip(*columns))
    files.write_json(folder / "metrics.json", metrics(outcome))


def write_torques(case: Case, predicted: np.ndarray, path: Path) -> Path:
    """Write measured and predicted torques (N, rows) of a recording and its joints (N, n), at about `TORQUE_RATE`."""
    motion, rows = case.motion, case.target.shape[1]
    step = max(1, round(motion.rate / TORQUE_RATE))
    names = [f"{what}_{j + 1}" for what in ("measured", "predicted") for j in range(rows)]
    joints = [f"q{j + 1}" for j in range(motion.q.shape[1])]
    table = np.column_stack([motion.t, case.target, predicted, motion.q])[::step]
    return files.write_table(path, ["t [s]", *names, *joints], table.tolist())


def estimate_rows(outcome: IdentificationOutcome) -> list[tuple[Any, ...]]:
    """Return name, expression, unit, value, σ, RSD [%] and the essential value of each parameter, then σ's two parts.

    σ is the total; the geometry's part is left out where the geometry is taken as exact. Terms that the evidence
    switched off have no σ: nobody measured them.
    """
    found = outcome.found
    estimate = found.fitted.estimate
    words = [line.split(" = ", 1)[1] for line in expressions(found.base)]
    off = switched_off(found.names, found.base.b, estimate.sigma)
    words += [
        f"{one.shape}, switched off: not measured" if one.name in off else one.shape for one in found.friction.terms
    ]
    carried = outcome.carried
    sigmas = estimate.sigma if carried is None else carried.sigma
    parts = [None] * len(sigmas) if carried is None or carried.geometry is None else carried.sigma_geometry.tolist()
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.where(estimate.values == 0.0, np.inf, 100.0 * sigmas / np.abs(estimate.values))
    essential = {}
    if found.elimination is not None:
        kept = found.elimination.essential.estimate
        essential = dict(zip(kept.names, kept.values))
    return [
        (
            name,
            expression,
            in_unit(unit, outcome.inputs.unit),
            float(value),
            None if name in off else float(sigma),
            None if name in off else _finite(rsd),
            _number(essential.get(own)),
            None if name in off else float(noise),
            None if name in off else part,
        )
        for name, own, expression, unit, value, sigma, rsd, noise, part in zip(
            found.names, estimate.names, words, estimate.units, estimate.values, sigmas, relative, estimate.sigma, parts
        )
    ]


def switched_off(names: Sequence[str], base: int, sigma: np.ndarray) -> tuple[str, ...]:
    """Return terms of richer friction (behind `base` columns) that the ridge holds at zero: their σ is its floor.

    Their rows of ``covariance.csv`` hold that floor, so that the model's other σ are those without the terms.
    """
    return tuple(name for name, own in zip(names[base:], sigma[base:]) if own < OFF)


def metrics(outcome: IdentificationOutcome) -> dict[str, Any]:
    """Return the content of ``metrics.json``."""
    found = outcome.found
    essential = found.base.b + len(found.friction.terms)
    if found.elimination is not None:
        essential = len(found.elimination.kept)
    return {
        "identification": {name: score_table(found_score) for name, found_score in outcome.fit.items()},
        "validation": {
            name: score_table(found_score) | {"evidence": name not in outcome.repeated}
            for name, found_score in outcome.validation.items()
        },
        "parameters": {
            "standard": found.dynamics.model.p,
            "base": found.base.b + len(found.friction.terms),
            "essential": essential,
        },
        "counts": {"without_effect": len(found.base.without_effect), "regrouped": len(found.base.regrouped)},
        "unit": outcome.inputs.unit,
        "drive_gains": gain_table(outcome.inputs.gains, outcome.inputs.unit),
        "rows": list(found.settings.torque_rows.numbered(outcome.inputs.chain.n)),
        "condition_number": {"raw": _finite(found.condition[0]), "normalised": _finite(found.condition[1])},
        "friction": found.friction.chosen,
        "switched_off": list(switched_off(found.names, found.base.b, found.fitted.estimate.sigma)),
        "method": found.fitted.method,
        "method_assumes": ASSUMES[found.fitted.method],
        "ladder": [
            {
                "model": rung.model,
                "parameters": rung.parameters,
                "cross_validated_percent": _finite(rung.cross_validated),
                "joints_percent": [_finite(x) for x in rung.joints],
                "kept_at_joints": [joint + 1 for joint in rung.kept_at],
                "kept": rung.kept,
                "note": rung.note,
            }
            for rung in found.friction.steps
        ],
        "ripple": [
            {
                "joint": one.joint + 1,
                "waves": [{"gear": source + 1, "order_per_turn": order} for source, order in one.waves],
                "explained_share_on_unseen_blocks": one.share,
            }
            for one in found.ripples
        ],
        "elimination": elimination_table(outcome),
        "loop": loop_table(found.bias),
        "tracking": tracking_table(outcome.tracking),
        "filters": {case.name: filter_table(case.motion) for case in (*outcome.inputs.cases, *outcome.inputs.unseen)},
        "geometry": geometry_tables.metrics(outcome.carried, outcome.geometries),
        "repeated": dict(outcome.repeated),
        "resting": asdict(resting_parameters(found)),
        "warnings": list(outcome.warnings),
        "verdict": outcome.verdict.level,
        "reason": outcome.verdict.reason,
        "seed": outcome.seed,
    }


def gain_table(found: DriveGains | None, unit: str) -> dict[str, Any] | None:
    """Return gains as identified, by joint: torque = gain · current; None where none were."""
    if found is None:
        return None
    return {
        "values": [float(x) for x in found.gains],
        "sigma": [float(x) for x in found.sigma],
        "covariance": found.covariance.tolist(),
        "unit": f"{unit} per A",
        "scale": found.scale,
    }


def score_table(found: Score) -> dict[str, Any]:
    """Return M of the contract, and what stands beside it."""
    return {
        "raw": part_table(found.raw),
        "filtered": part_table(found.filtered),
        "moving": part_table(found.moving),
        "standing": part_table(found.standing),
        "above_band_percent": [_finite(x) for x in found.above],
        "r_squared": [_finite(x) for x in found.r_squared],
        "whiteness": [
            None
            if w is None
            else {"outside": w.outside, "ljung_box_p": w.ljung_box_p, "normal_p": w.normal_p, "kurtosis": w.kurtosis}
            for w in found.whiteness
        ],
        "motion_share": found.motion_share,
    }


def part_table(part: TorqueErrors) -> dict[str, Any]:
    relative = {"total": _finite(part.total), "joints": [_finite(x) for x in part.joints]}
    return {"relative_error_percent": relative, "rms": [_finite(x) for x in part.rms], "samples": part.samples}


def filter_table(motion: Any) -> dict[str, Any]:
    return {
        "rate": float(motion.rate),
        "cutoff": [float(x) for x in motion.cutoff],
        "band": float(motion.band),
        "decimation": int(motion.decimator.factor),
    }


def elimination_table(outcome: IdentificationOutcome) -> list[dict[str, Any]]:
    gone = outcome.found.elimination
    if gone is None:
        return []
    return [
        {"name": step.name, "rsd": _finite(step.rsd), "f": _finite(step.f), "p": _finite(step.p), "listed": step.listed}
        for step in gone.steps
    ]


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _number(value: float | None) -> float | None:
    return None if value is None else float(value)
