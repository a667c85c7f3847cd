"""Fit the geometry of a parallel robot to a CSV of encoder readings, with platform poses beside them or without.

Columns: one per actuated joint, by its name [rad or m, or the unit in brackets behind it]; and, where the platform was
measured, one per coordinate of its freedom (``x [mm]``, ``rz [deg]``), counted from home in the base's axes. Of the
options file ``fix`` counts: names of constants that stay, as ``estimate.csv`` has them.

Verdict, by rows the fit has not seen (validation files, rows held out; else rows of four folds left out in turn): fail
where a tolerance is exceeded or the calibrated robot is worse than the nominal one; marginal where there are no such
rows, where errors are three times the fit's own, where the gain is below 10 %, or where only encoders were read, which
give neither scale nor place; else pass.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from calib.api.rendering import as_text, data_frame
from calib.data.csv_table import Table, read_table
from calib.data.poses.fit_options import FitOptions
from calib.errors import CalibError, MeasurementError, NoPosture, UsageError, refuse_data, refuse_option, suggestion
from calib.estimate_files import COVARIANCE, ESTIMATE, write_covariance, write_estimate
from calib.estimation.estimate import Estimate
from calib.procedure.findings import Verdict, limit
from calib.procedure.kinematic_stage.settings import FitSettings
from calib.procedure.robot_kinds import refuse_unread
from calib.robot.calibrated import ROBOT
from calib.rooms.parallel.mechanism.closure import ClosedRobot
from calib.rooms.parallel.mechanism.geometric_fit import (
    LoopFit,
    contradictions,
    fit_loops,
    loop_parameters,
    platform_errors,
)
from calib.rooms.parallel.mechanism.parallel_robot import COORDINATES, ParallelRobot
from calib.rooms.parallel.results import ParallelResult, ResultFolder, finite
from calib.rooms.parallel.robots import ParallelMechanism

READ = ("holdout", "tolerance", "seed")  # of the settings


@dataclass(frozen=True, eq=False)
class _Rows:
    """Encoder readings (m, n), with platform coordinates (m, r) or None."""

    readings: np.ndarray
    coordinates: np.ndarray | None

    def __len__(self) -> int:
        return len(self.readings)

    def part(self, rows: np.ndarray) -> _Rows:
        """Return some of the rows."""
        return _Rows(self.readings[rows], None if self.coordinates is None else self.coordinates[rows])


@dataclass(frozen=True, eq=False, repr=False)
class ParallelFit(ParallelResult):
    """A geometric calibration and its files.

    Attributes:
        nominal: the robot before.
        files: that were read.
        rows: that were fitted.
        found: the calibration.
        own: errors on the fitted rows, nominal and calibrated (2, m, k): platform coordinates; or what encoders
            contradict each other by.
        unseen: the same of unseen rows, by name.
        verdict: pass, marginal or fail, with its reason.
        settings: what was asked for.
    """

    nominal: ParallelMechanism
    files: tuple[Path, ...]
    rows: _Rows
    found: LoopFit
    own: np.ndarray
    unseen: Mapping[str, np.ndarray]
    verdict: Verdict
    settings: FitSettings
    folder: ClassVar = ResultFolder((ESTIMATE, COVARIANCE), (ROBOT,), "fit")

    @property
    def robot(self) -> ParallelMechanism:
        """The calibrated robot: what identification, excitation and planning take."""
        return ParallelMechanism(self.found.known, self.nominal.source)

    @property
    def estimate(self) -> Estimate:
        """Changes of the loops' constants [m, rad] with their covariance."""
        return self.found.estimate

    @property
    def origin(self) -> tuple[str, dict[str, Any]]:
        """Where the calibrated robot is from, and which files it was fitted to."""
        return f"calibrated from {self.nominal.source}", {"files": [str(each) for each in self.files]}

    def write(self, folder: Path, plots: bool) -> None:
        """Write the estimate."""
        found = self.estimate
        rows = zip(found.names, found.units, found.values.tolist(), map(finite, found.sigma))
        write_estimate(folder, ("name", "unit", "value", "sigma"), list(map(list, rows)))
        write_covariance(folder / COVARIANCE, found.names, found.covariance)

    @property
    def columns(self) -> tuple[str, ...]:
        """What the errors are of."""
        if self.rows.coordinates is not None:
            return self.nominal.known.robot.freedom
        return tuple(f"contradiction {k + 1}" for k in range(self.own.shape[2]))

    @property
    def judged(self) -> Mapping[str, np.ndarray]:
        """Errors of unseen rows, by name; of the fitted ones where there are none."""
        return self.unseen or {"fitted": self.own}

    def to_dataframe(self) -> Any:
        """Return the estimate as a pandas DataFrame: name, unit, value, sigma."""
        found = self.estimate
        rows = zip(found.names, found.units, found.values.tolist(), found.sigma.tolist())
        return data_frame(rows, ["name", "unit", "value", "sigma"])

    def renderables(self) -> Iterator[Any]:
        """Yield what ``print`` shows, for a rich console."""
        from calib.procedure.report.console import section
        from calib.procedure.report.page import Section

        yield from self.lines()
        yield from section(Section("", (), self.verdict.level, self.verdict.reason))

    def __repr__(self) -> str:
        return f"<ParallelFit of {self.robot.known.robot.name}: {self.verdict.level}>"

    def __str__(self) -> str:
        return as_text(self.renderables())

    def to_dict(self) -> dict[str, Any]:
        """Return the content of ``metrics.json``."""
        robot, found = self.nominal.known.robot, self.found
        both = np.concatenate(list(self.judged.values()), axis=1)
        errors = {
            key: dict(zip(self.columns, row.tolist()))
            for key, row in zip(("nominal", "calibrated"), np.sqrt(np.mean(both**2, axis=1)))
        }
        platform = self.rows.coordinates is not None
        return {
            "robot": robot.name, "parameters": len(found.parameters), "not_told": list(found.vague),
            "reading_rms": {"nominal": found.before, "calibrated": found.after},
            "platform_rms": errors if platform else None, "contradiction_rms": None if platform else errors,
            "judged_on": ", ".join(self.judged), "iterations": found.iterations,
            "verdict": {"level": self.verdict.level, "reason": self.verdict.reason},
        }  # fmt: skip

    def lines(self) -> list[str]:
        """Return what the command prints."""
        robot, found = self.nominal.known.robot, self.found
        told = len(found.parameters) - len(found.vague)
        lines = [
            f"{robot.name}: {len(found.parameters)} constants of the loops, {told} identified; encoders off by "
            f"{found.before:.3g}, calibrated by {found.after:.3g} (rms, rad or m)"
        ]
        for where, errors in self.judged.items():
            for name, (before, after) in zip(self.columns, 1e3 * np.sqrt(np.mean(errors**2, axis=1)).T):
                what = f"platform {name}" if name in robot.freedom else name
                unit = "mm" if name in COORDINATES[:3] else "mrad" if name in COORDINATES else "mrad (or mm)"
                lines.append(f"  {what} on {where} rows: {before:.3g} -> {after:.3g} {unit} rms")
        if self.rows.coordinates is None:
            lines.append(
                "from readings alone: scale and place of the whole robot are the nominal ones; what encoders "
                "contradict each other by is mended"
            )
        return lines

    def with_unseen(self, unseen: Sequence[str | Path]) -> ParallelFit:
        """Return a fit judged anew on more unseen files beside those of before; nothing is fitted again."""
        known, validate = self.nominal.known, _paths(unseen)
        more = {f"{path.name}, unseen": read_rows(path, known.robot) for path in validate}
        _check_alike(self.rows, more)
        proofs = {name: errors for name, errors in self.unseen.items() if name.endswith("unseen")}
        proofs |= {name: _errors(known, self.found.known, own) for name, own in more.items()}
        verdict = _judge(known.robot, self.rows, self.own, proofs, self.settings.tolerance)
        return replace(self, unseen=proofs, verdict=verdict, files=(*self.files, *validate))


def fit_parallel(
    robot: ParallelMechanism,
    measured: Sequence[str | Path],
    validate: Sequence[str | Path] = (),
    *,
    settings: FitSettings | None = None,
    options: FitOptions | None = None,
    poses: object = None,
    progress: Callable[[str], None] | None = None,
) -> ParallelFit:
    """Fit the geometry of a parallel robot to measured files, and judge it on rows it has not seen.

    Args:
        settings: holdout, tolerance and seed; the others are for serial arms.
        options: ``fix`` alone; poses: None, since none are chosen for parallel robots.

    Raises:
        UsageError: for options that only serial arms know.
        MeasurementError: for columns that are missing, or rows that no posture reaches.
        Unidentifiable: for readings alone of a robot without redundant encoders.
    """
    if poses is not None:
        raise UsageError("poses of a parallel robot are not chosen here, so that nothing was predicted of its fit")
    say, settings, known = progress or (lambda words: None), settings or FitSettings(), robot.known
    measured, validate = _paths(measured), _paths(validate)
    held = _held(known, settings, options or FitOptions())
    rows = _stacked([read_rows(path, known.robot) for path in measured], measured)
    unseen = {f"{path.name}, unseen": read_rows(path, known.robot) for path in validate}
    _check_alike(rows, unseen)
    if settings.tolerance is not None and (rows.coordinates is None or not _positions(known.robot).any()):
        raise UsageError("a tolerance is of the platform's position, and none was measured")
    if settings.holdout:
        order = np.random.default_rng(settings.seed).permutation(len(rows))
        kept = len(rows) - round(settings.holdout * len(rows))
        unseen["held out, unseen"], rows = rows.part(order[kept:]), rows.part(order[:kept])
    say("fitting")
    try:
        found = fit_loops(known, rows.readings, rows.coordinates, held=held)
        say("judging")
        proofs = {name: _errors(known, found.known, own) for name, own in unseen.items() if len(own)}
        own = _errors(known, found.known, rows)
    except NoPosture as error:
        raise MeasurementError(f"{error}", measured[0]) from error
    if not proofs:
        proofs = _cross_validated(known, rows, held, settings.seed)
    verdict = _judge(known.robot, rows, own, proofs, settings.tolerance)
    return ParallelFit(robot, (*measured, *validate), rows, found, own, proofs, verdict, settings)


def _paths(measured: Sequence[object]) -> tuple[Path, ...]:
    if all(isinstance(one, (str, Path)) for one in measured):
        return tuple(Path(str(one)) for one in measured)
    raise UsageError("a parallel robot's measurements are CSV files (calib formats parallel), not values in memory")


def read_rows(path: Path, robot: ParallelRobot) -> _Rows:
    """Return readings (m, n) and platform coordinates (m, r), None where the file has no such columns.

    Raises:
        MeasurementError: naming the column that is missing, and which there are.
    """
    table = read_table(path)
    readings = [table.numbers(joint.name, "angle" if joint.kind == "revolute" else "length") for joint in robot.joints]
    present = [name for name in robot.freedom if name in table]
    _refuse_others(table, robot, path)
    if not present:
        return _Rows(np.column_stack(readings), None)
    return _Rows(np.column_stack(readings), read_coordinates(table, robot))


def read_coordinates(table: Table, robot: ParallelRobot) -> np.ndarray:
    """Return platform coordinates (m, r) [m, rad] of a table.

    Raises:
        MeasurementError: naming the column that is missing.
    """
    columns = [table.numbers(name, "length" if name in COORDINATES[:3] else "angle") for name in robot.freedom]
    return np.column_stack(columns)


def _held(known: ClosedRobot, settings: FitSettings, options: FitOptions) -> tuple[str, ...]:
    """Return the names of constants that stay, after refusing what only serial arms know."""
    refuse_unread(settings, FitSettings(), READ)
    refuse_unread(options, FitOptions(), ("source", "fix"), options.source)
    names = [one.name for one in loop_parameters(known)]
    for name in options.fix:
        if name not in names:
            refuse_option(options.source, f"fix '{name}' is no constant of the loops{suggestion(name, names)}")
    return options.fix


def _refuse_others(table: Table, robot: ParallelRobot, path: Path) -> None:
    passive = [joint.name for leg in robot.legs for joint in leg.chain.joints if joint.name not in robot.joint_names]
    for name in table.header:
        if name in passive:
            refuse_data(
                path, f"column '{name}' is of a passive joint, whose encoder the fit does not know yet; leave it out"
            )
        if name in COORDINATES and name not in robot.freedom:
            refuse_data(
                path,
                f"column '{name}' is none of the platform's coordinates ({', '.join(robot.freedom)}); leave it out",
            )


def _stacked(parts: Sequence[_Rows], paths: Sequence[Path]) -> _Rows:
    with_poses = [own.coordinates is not None for own in parts]
    if any(with_poses) != all(with_poses):
        bare = paths[with_poses.index(False)]
        raise UsageError(f"{bare} has no platform coordinates, other files have: fit them apart")
    readings = np.concatenate([own.readings for own in parts])
    coordinates = [own.coordinates for own in parts if own.coordinates is not None]
    return _Rows(readings, np.concatenate(coordinates) if coordinates else None)


def _check_alike(rows: _Rows, unseen: Mapping[str, _Rows]) -> None:
    for name, own in unseen.items():
        if (own.coordinates is None) != (rows.coordinates is None):
            refuse_option(name, "platform coordinates are in it or in the fitted files, not in both")


def _errors(nominal: ClosedRobot, calibrated: ClosedRobot, rows: _Rows) -> np.ndarray:
    """Return the errors of both robots (2, m, k): platform coordinates, or the encoders' contradictions."""
    if rows.coordinates is None:
        return np.array([contradictions(known, rows.readings) for known in (nominal, calibrated)])
    return np.array([platform_errors(known, rows.readings, rows.coordinates) for known in (nominal, calibrated)])


def _cross_validated(known: ClosedRobot, rows: _Rows, held: Sequence[str], seed: int) -> dict[str, np.ndarray]:
    """Return errors of all rows, each by a fit that has not seen it; nothing where a fold cannot be fitted."""
    folds_wanted = 4  # of the rows, where none are unseen
    folds = np.array_split(np.random.default_rng(seed).permutation(len(rows)), folds_wanted)
    found = []
    for k, own in enumerate(folds):
        rest = rows.part(np.concatenate(folds[:k] + folds[k + 1 :]))
        try:
            fitted = fit_loops(known, rest.readings, rest.coordinates, held=held)
            found.append(_errors(known, fitted.known, rows.part(own)))
        except CalibError:
            return {}
    return {"left out": np.concatenate(found, axis=1)}


def _positions(robot: ParallelRobot) -> np.ndarray:
    return robot.selected < 3


def _judge(
    robot: ParallelRobot, rows: _Rows, own: np.ndarray, proofs: Mapping[str, np.ndarray], tolerance: float | None
) -> Verdict:
    """Return the verdict by the rules of the module."""
    kinds = {"": (np.ones(own.shape[2], dtype=bool), 1e3, "mrad (or mm)")}
    if rows.coordinates is not None:
        turns = ~_positions(robot)
        kinds = {"position ": (~turns, 1e3, "mm"), "orientation ": (turns, 1e3, "mrad")}
    told, small, far = [], [], []
    for where, errors in proofs.items():
        for kind, (columns, factor, unit) in kinds.items():
            if not columns.any():
                continue
            before, after = (_rms(one[:, columns]) for one in errors)
            both = f"{kind}rms on {where} rows: {factor * before:.3g} {unit} nominal, {factor * after:.3g} calibrated"
            if tolerance is not None and kind == "position " and after > tolerance:
                return Verdict("fail", f"{both}, above the tolerance of {1e3 * tolerance:g} mm")
            if after > limit("worse-than-nominal", "times") * before:
                return Verdict("fail", f"the calibrated robot is worse than the nominal one: {both}")
            told.append(both)
            small += [both] if after > limit("small-gain", "left", "marginal") * before else []
            fitted = _rms(own[1][:, columns])
            far += (
                [f"{both}, {after / fitted:.1f} times the fit's own"]
                if after > limit("no-transfer", "times", "marginal") * fitted
                else []
            )
    if not told:
        return Verdict("marginal", "there are no unseen rows, and too few to leave some out: measure more poses")
    if rows.coordinates is None:
        return Verdict("marginal", f"{told[0]}; readings alone give neither scale nor place: measure platform poses")
    if far or small:
        return Verdict("marginal", far[0] if far else f"the gain is small: {small[0]}; it may be calibrated already")
    kept = "" if tolerance is None else f", within the tolerance of {1e3 * tolerance:g} mm"
    return Verdict("pass", f"{'; '.join(told)}{kept}")


def _rms(errors: np.ndarray) -> float:
    """Return the rms length of rows (m, k)."""
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))
