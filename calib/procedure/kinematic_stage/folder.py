"""The folder of a fit: written whole, beside its place, then moved there."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from calib import files
from calib.errors import UsageError
from calib.folders import check_folder, write_staged
from calib.procedure.kinematic_stage import robot_file
from calib.procedure.kinematic_stage.fit import Outcome
from calib.procedure.kinematic_stage.residual_table import write_residuals
from calib.procedure.kinematic_stage.tables import HEADER, estimate_table
from calib.robot import calibrated
from calib.robot.calibrated import CorrectedChain
from calib.robot.formats import urdf_write

OURS = (
    calibrated.ROBOT, "robot.urdf", "robot_for_corrections.urdf",
    "estimate.csv", "covariance.csv", calibrated.COVARIANCE, "residuals.csv", "joint_corrections.csv",
    "joint_corrections.txt", "report.json", "certificate.html", "metrics.json",
)  # fmt: skip
"""Files of an earlier fit that a new one replaces; besides plots, ``plot_*.png``."""

CORRECTIONS = """Joint corrections that a URDF cannot hold.

robot.urdf               the best geometry for whoever does not apply them
robot_for_corrections.urdf   the geometry they belong to, which is worse alone

At joint values q, add to the joint (or element) of each row of joint_corrections.csv

    delta = sum over its rows of  coefficient * b(q)

    basis   b(q)
    torque  gravity torque of `joint` at q [N m] (of the robot's masses; a static arm's drives show +g(q))
    lever   component along gravity of  z_element x (axis `order` of the body behind `joint`; 0 x, 1 y, 2 z)
    joint   q of `joint` [rad or m]
    cos     cos(order * q of `joint`)
    sin     sin(order * q of `joint`)

To make the arm stand where the calibrated model says: predict with q + delta(q) in robot_for_corrections.urdf; to
command a joint position for which that file wants q, send q - delta(q) (one step is enough; delta is small).
robot.toml holds the same geometry and terms, and `calib.robot.calibrated.read` reads them.
"""


def check_target(out: Path, source: Path | None = None) -> None:
    """Refuse, before any work is done, a folder that cannot be written or whose files are not ours to replace."""
    check_folder(out)
    if source is not None and source.resolve().parent == out.resolve() and source.name in OURS:
        raise UsageError(f"{out} holds the robot that is to be calibrated; choose another folder for --out")
    present = [name for name in OURS if (out / name).exists()]
    if present and not (out / "metrics.json").exists():
        raise UsageError(f"{out} holds {', '.join(present)} which no earlier fit has left there; choose another --out")


def write_folder(outcome: Outcome, out: Path, plots: Callable[[Outcome, Path], None] | None = None) -> Path:
    """Write all files of a fit, all or none; see `calib.folders`."""
    check_target(out, outcome.inputs.source)

    def write(folder: Path) -> None:
        _write_all(outcome, folder)
        if plots is not None:
            plots(outcome, folder)

    return write_staged(out, OURS, write)


def _write_all(outcome: Outcome, folder: Path) -> None:
    fit, chain = outcome.climb.fit, outcome.inputs.chain
    robot, origin = outcome.calibrated, f"calibrated from {outcome.inputs.source}"
    calibrated.write(folder, robot, robot_file.frame_tables(fit.cell), _record(outcome), origin)
    urdfs = {"robot.urdf": robot.chain}
    if robot.corrections is not None:
        urdfs["robot_for_corrections.urdf"] = robot.corrections.chain
        write_corrections(robot.corrections, folder)
    for name, geometry in urdfs.items():
        if outcome.inputs.source.suffix == ".urdf":
            urdf_write.edit_file(outcome.inputs.source, folder / name, chain, geometry)
        else:
            files.write(folder / name, urdf_write.write_new(geometry))
    table = estimate_table(fit, outcome.climb.nominal.cell)
    files.write_table(folder / "estimate.csv", HEADER, table.rows())
    rows = ([name, *map(float, row)] for name, row in zip(table.names, table.covariance))
    files.write_table(folder / "covariance.csv", ("name", *table.names), rows)
    write_residuals(outcome, folder / "residuals.csv")
    files.write_json(folder / "metrics.json", metrics(outcome))


def metrics(outcome: Outcome) -> dict[str, object]:
    """Return the content of ``metrics.json``."""
    return {
        "fit": {"parameters": len(outcome.climb.fit.free), **outcome.fit.table()},
        "validation": {name: comparison.table() for name, comparison in outcome.validation.items()},
        "model": outcome.climb.chosen,
        "loss": outcome.climb.loss,
        "ladder": [
            {
                "model": rung.model,
                "parameters": rung.parameters,
                "cross_validated_mm": 1e3 * rung.cross_validated,
                "kept": rung.kept,
                "note": rung.note,
            }
            for rung in outcome.climb.rungs
        ],
        "seed": outcome.seed,
        "status": outcome.climb.fit.solution.status.name.lower(),
        "verdict": outcome.verdict.level,
        "reason": outcome.verdict.reason,
        "tolerance_mm": None if outcome.tolerance is None else 1e3 * outcome.tolerance,
        "warnings": list(outcome.warnings),
        "not_identifiable": list(outcome.unclear),
        "outliers": [
            {
                "file": each.file,
                "row": each.row,
                "nature": each.nature,
                "sigmas": each.sigmas,
                "size_deg" if each.nature == "orientation" else "size_mm": each.size
                * (np.degrees(1.0) if each.nature == "orientation" else 1e3),
            }
            for each in outcome.outliers
        ],
    }


def _record(outcome: Outcome) -> dict[str, object]:
    """Return what the provenance says of how the robot was calibrated, besides from what."""
    inputs = outcome.inputs
    again = inputs.earlier is not None and inputs.earlier.nominal is not None
    frames = {} if again else robot_file.frame_tables(outcome.climb.nominal.cell)
    return {
        **{f"nominal_{kind}": table for kind, table in frames.items()},
        "files": [block.file for block in inputs.fit],
        "model": outcome.climb.chosen,
        "seed": outcome.seed,
        "verdict": f"{outcome.verdict.level}: {outcome.verdict.reason}",
        "covariance": "covariance.csv",
    }


def write_corrections(corrections: CorrectedChain, folder: Path) -> None:
    """Write what a URDF cannot hold: the joint correction table and how to read it."""
    chain, deflection = corrections.chain, corrections.deflection
    units = dict(zip(chain.names, chain.units))
    owners = {element.name: element.joint for element in chain.elements}
    rows = []
    for term, value in zip(deflection.terms, np.asarray(deflection.coefficients)):
        joint = owners[term.element]
        target = term.element if joint is None else chain.joint_names[joint]
        rows.append([target, units[term.element], term.basis, chain.joint_names[term.source], term.order, float(value)])
    files.write_table(
        folder / "joint_corrections.csv", ("corrected", "unit", "basis", "joint", "order", "coefficient"), rows
    )
    files.write(folder / "joint_corrections.txt", CORRECTIONS)
