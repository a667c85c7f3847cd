"""Identify a parallel robot from encoders and motor torques: rows on its platform, its actuators, or their power."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from calib import files
from calib.data.recordings.recording import Recording
from calib.data.signals.persistency import ExcitationReport, report_excitation
from calib.dynamics.base import expressions
from calib.dynamics.regressor_model import RegressorModel
from calib.errors import MeasurementError, UsageError, refuse_option
from calib.estimate_files import COVARIANCE, ESTIMATE, write_covariance, write_estimate
from calib.estimation.estimate import Estimate
from calib.identification.cases import Case, case_names, make_case
from calib.identification.identify import Identification, identify_model
from calib.identification.identify_options import IdentifyOptions
from calib.identification.methods.method import Method
from calib.identification.methods.registry import METHODS, method_named
from calib.identification.model_file import MODEL
from calib.identification.prediction import predict
from calib.identification.scores import Score, score
from calib.identification.settings import IdentificationSettings, per_joint
from calib.procedure.dynamic_stage.inputs import read_motion
from calib.procedure.dynamic_stage.validation import repeated_motion
from calib.procedure.dynamic_stage.verdict import (
    judge,
    motion_warnings,
    parameter_warnings,
    resting_parameters,
    with_duration,
    with_prior,
)
from calib.procedure.findings import Verdict
from calib.procedure.robot_kinds import refuse_unread
from calib.robot.calibrated import ROBOT
from calib.rooms.parallel.mechanism.closure import NoPosture
from calib.rooms.parallel.mechanism.parallel_model import PLATFORM, ParallelModel, make_parallel_model, rows_named
from calib.rooms.parallel.results import JudgedResult, ResultFolder, finite
from calib.rooms.parallel.robots import ParallelMechanism
from calib.workers.threads import one_blas_thread

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from calib.procedure.report.charts import Chart

OF_ARMS = {"couplings", "terms", "loop", "gravity", "payload_values"}  # settings
APART = 1e-3  # rms by which redundant encoders contradict each other from which it is said [rad or m] (our choice)
RATE = 100.0  # of torques_1.csv [Hz]
FEW = 200  # samples of a recording at which they are asked
DRIVEN = -0.01  # of the energy that the actuators move, as `calib.identification.friction.passivity.MIN_ENERGY_SHARE`

Recorded = str | Path | Recording


@dataclass(frozen=True, eq=False, repr=False)
class ParallelDynamics(JudgedResult):
    """What an identification of a parallel robot came to.

    Attributes:
        robot: with its file.
        model: what was identified.
        options: how recordings were read.
        found: the model with numbers, estimate and elimination.
        cases, unseen: training recordings, and others.
        fit, validation: case name → score.
        verdict: pass, marginal or fail, by the rules of serial arms (`calib.procedure.dynamic_stage.verdict`).
        notes: what a user should know.
    """

    robot: ParallelMechanism
    model: ParallelModel
    options: IdentifyOptions
    found: Identification[RegressorModel]
    cases: tuple[Case, ...]
    unseen: tuple[Case, ...]
    fit: Mapping[str, Score]
    validation: Mapping[str, Score]
    verdict: Verdict
    notes: tuple[str, ...]
    folder: ClassVar = ResultFolder(
        (MODEL, ESTIMATE, COVARIANCE, "torques_1.csv", "plot_*.png"), (MODEL,), "identification"
    )

    @property
    def estimate(self) -> Estimate:
        """The base parameters with their covariance."""
        return self.found.fitted.estimate

    @property
    def _essential(self) -> Mapping[str, float]:
        """The essential parameters' values by their names; empty where none were asked for."""
        gone = self.found.elimination
        return {} if gone is None else dict(zip(gone.essential.estimate.names, gone.essential.estimate.values))

    @one_blas_thread()
    def torques(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the rows (N, rows) of a motion q, v, a (N, n) of the actuated joints, no payload on board.

        Torques of the actuators [N m or N]; of redundant ones the forces on the platform's coordinates they share; or
        their power [W]: as the model was identified.
        """
        return self.model.torque(self.found.dynamics.values, q, v, a, ())

    @one_blas_thread()
    def plot(self) -> dict[str, Figure]:
        """Return the figures by name: measured and predicted rows."""
        from calib.procedure.report import charts

        return charts.figures(self._charts())

    def _charts(self) -> dict[str, Chart]:
        from calib.procedure.report.dynamics_figures import torques

        drawn, prismatic = {}, [joint.kind == "prismatic" for joint in self.robot.known.robot.joints]
        for number, case in enumerate((*self.cases, *self.unseen), 1):
            target, model = (case.motion.in_band(x) for x in (case.target, predict(self.found.dynamics, case)))
            rows, units = case.torque_rows.numbered(case.motion.n), case.torque_rows.units(prismatic)
            drawn[f"torque_{number}"] = torques(case.motion.t, target, model, rows, units, case.name)
        return drawn

    def write(self, folder: Path, plots: bool) -> None:
        """Write estimate, model, torques and figures."""
        found, estimate, essential = self.found, self.estimate, self._essential
        words = [line.split(" = ", 1)[1] for line in expressions(found.base)]
        write_estimate(folder, ("name", "expression", "unit", "value", "sigma", "rsd", "essential"), [
            [name, expression, unit, float(value), finite(sigma), finite(rsd), essential.get(own)]
            for name, expression, unit, value, sigma, rsd, own in zip(
                found.names, words, estimate.units, estimate.values, estimate.sigma, estimate.rsd, estimate.names
            )
        ])  # fmt: skip
        write_covariance(folder / COVARIANCE, found.names, estimate.covariance)
        files.write_json(folder / MODEL, {
            "robot": ROBOT, "kind": self.model.torque_rows.name, "payloads": list(self.model.payloads),
            "v0": found.settings.v0[0], "values": dict(zip(self.model.names, map(float, found.dynamics.values))),
            "base": dict(zip(found.names, words)), "covariance": COVARIANCE,
        })  # fmt: skip
        case = (*self.unseen, *self.cases)[0]
        step, labels = max(1, round(case.motion.rate / RATE)), case.torque_rows.numbered(case.motion.n)
        header = ["t [s]", *(f"{what}_{label}" for what in ("measured", "predicted") for label in labels)]
        table = np.column_stack([case.motion.t, case.target, predict(found.dynamics, case)])
        files.write_table(folder / "torques_1.csv", header, table[::step].tolist())
        if plots:
            from calib.procedure.report.charts import save_all

            save_all(self._charts(), folder)

    def to_dict(self) -> dict[str, Any]:
        """Return the metrics as ``metrics.json`` holds them."""
        found, gone = self.found, self.found.elimination
        return {
            "robot": self.robot.known.robot.name,
            "rows": list(self.model.torque_rows.numbered(self.model.n)),
            "method": found.fitted.method,
            "verdict": {"level": self.verdict.level, "reason": self.verdict.reason},
            "identification": {name: _errors(one) for name, one in self.fit.items()},
            "validation": {name: _errors(one) for name, one in self.validation.items()},
            "parameters": {
                "standard": self.model.p, "base": found.base.b,
                "essential": found.base.b if gone is None else len(gone.kept),
            },
            "condition_number": dict(zip(("raw", "normalised"), map(finite, found.condition))),
            "elimination": [] if gone is None else [{"name": one.name, "rsd": finite(one.rsd)} for one in gone.steps],
            "notes": list(self.notes),
            "seed": found.settings.seed,
        }  # fmt: skip

    def lines(self) -> list[str]:
        """Return what the command prints."""
        robot, found, rows = self.robot.known.robot, self.found, self.model.torque_rows
        lines = [
            f"{robot.name}: {len(robot.legs)} legs, {robot.n} actuators, {robot.r} freedoms "
            f"({', '.join(robot.freedom)}); rows: {rows.name}, {found.base.b} base parameters of {self.model.p}, by "
            f"{found.fitted.method}"
        ]
        essential, estimate = self._essential, self.estimate
        for name, own, unit, value, sigma, rsd in zip(
            found.names, estimate.names, estimate.units, estimate.values, estimate.sigma, estimate.rsd
        ):
            kept = "" if not essential or own in essential else "  not essential"
            lines.append(f"  {name:8} {value:12.5g} ± {sigma:.2g} {unit} ({rsd:.3g} %){kept}")
        for what, scores in (("learnt from", self.fit), ("unseen", self.validation)):
            lines += [
                f"{name} ({what}): {one.filtered.total:.3g} % of the {rows.name} rows" for name, one in scores.items()
            ]
        return [*lines, *self.notes]

    def with_unseen(self, validate: Sequence[Recorded]) -> ParallelDynamics:
        """Return an outcome judged anew on more unseen recordings; nothing is identified."""
        known = (*self.cases, *self.unseen)
        more = _cases(self.robot, self.model, self.options, validate, known, lambda words: None)
        return _assessed(self.robot, self.model, self.options, self.found, self.cases, (*self.unseen, *more))


def identify_parallel(
    robot: ParallelMechanism,
    recordings: Sequence[Recorded],
    validate: Sequence[Recorded] = (),
    *,
    options: IdentifyOptions | None = None,
    method: str | None = None,
    friction: str | None = None,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> ParallelDynamics:
    """Identify the dynamics of a parallel robot from recordings of its actuated joints, and judge it.

    Args:
        recordings, validate: files with a cut if wanted, or recordings in memory.
        options: filters, payloads, drives, method; ``rows``: motor (on the platform's coordinates where actuators are
            redundant) or power; ``passive``: friction of the passive joints.
        method, friction: in place of the options'.

    Raises:
        UsageError: for options that only serial arms know.
        MeasurementError: for recordings that cannot be right.
    """
    say, options = progress or (lambda words: None), options or IdentifyOptions()
    chosen = {"method": method, "friction": friction}
    settings = replace(
        options.settings, seed=seed, **{key: value for key, value in chosen.items() if value is not None}
    )
    _refuse(settings, options)
    known = robot.known
    wanted = settings.torque_rows.name
    rows = rows_named(known, "" if wanted == "motor" else wanted)
    model = make_parallel_model(
        known, settings.sets, per_joint(settings.v0, 1, "v0")[0], rows, tuple(settings.payloads), settings.passive
    )
    learnt = _cases(robot, model, options, recordings, (), say)
    unseen = _cases(robot, model, options, validate, learnt, say)
    settings = replace(settings, torque_rows=rows)
    found = identify_model(model, learnt, settings, cad=model.known_parameters(), progress=progress)
    return _assessed(robot, model, options, found, learnt, unseen)


def _cases(
    robot: ParallelMechanism, model: ParallelModel, options: IdentifyOptions, given: Sequence[Recorded],
    before: Sequence[Case], say: Callable[[str], None],
) -> tuple[Case, ...]:  # fmt: skip
    """Return the cases of recordings; the band of those `before` serves where the options state none."""
    paths = [str(each.file if isinstance(each, Recording) else each) for each in given]
    names = case_names([*(case.name for case in before), *paths])[len(before) :]
    cases = []
    for name, path, each in zip(names, paths, given):
        say(f"reading {name}")
        own = options.file_settings(path)
        motion = read_motion(each, robot.joints, own, before[0].motion if before else None)
        gains = None if own.gains is None else np.array(per_joint(own.gains, model.n, "gains"))
        if motion.kind == "current" and gains is None and motion.drive_gain is None:
            refuse_option(name, "currents without drive gains; state gains = [...] (N m/A) in the options file")
        gains = motion.drive_gain if gains is None and motion.kind == "current" else gains
        try:
            cases.append(make_case(name, motion, model.torque_rows, gains=gains, carried=own.payload))
        except NoPosture as error:
            raise MeasurementError(f"{error}", name) from error
    return tuple(cases)


def _assessed(
    robot: ParallelMechanism, model: ParallelModel, options: IdentifyOptions, found: Identification[RegressorModel],
    cases: tuple[Case, ...], unseen: tuple[Case, ...],
) -> ParallelDynamics:  # fmt: skip
    """Return the outcome: every recording predicted, and the verdict that follows."""
    scores = {case.name: score(case, predict(found.dynamics, case)) for case in (*cases, *unseen)}
    fit, validation = ({case.name: scores[case.name] for case in part} for part in (cases, unseen))
    repeated = repeated_motion(cases, unseen)
    excitation = {case.name: report_excitation(case.motion) for case in cases}
    proofs = {name: one for name, one in validation.items() if name not in repeated}
    notes = (
        *_contradictions(model, (*cases, *unseen)), *motion_warnings(validation, repeated, excitation),
        *parameter_warnings(found), *_payload_notes(model, found, cases), *_redundancy_notes(model),
        *_recording_notes(model, (*cases, *unseen)),
    )  # fmt: skip
    verdict = _judged(model, found, cases, fit, proofs, repeated, excitation)
    return ParallelDynamics(robot, model, options, found, cases, unseen, fit, validation, verdict, notes)


def _judged(
    model: ParallelModel, found: Identification[RegressorModel], cases: Sequence[Case], fit: Mapping[str, Score],
    proofs: Mapping[str, Score], repeated: Mapping[str, float], excitation: Mapping[str, ExcitationReport],
) -> Verdict:  # fmt: skip
    if driven := _driven_joints(model, found, cases):
        return Verdict(
            "fail",
            f"friction drives joint {', '.join(driven)} instead of braking it, as in no robot: is a torque's sign "
            "reversed, are columns swapped, is a payload on board that the options do not name?",
        )
    labels = found.settings.torque_rows.titles(model.known.robot.joint_names)
    kind = "platform" if model.torque_rows.name == PLATFORM else "joint"
    verdict = judge(fit, proofs, repeated, excitation, (), labels, kind)
    return with_duration(with_prior(verdict, resting_parameters(found)), excitation)


def _driven_joints(
    model: ParallelModel, found: Identification[RegressorModel], cases: Sequence[Case]
) -> tuple[str, ...]:
    """Return names of joints whose friction gives energy, as a share of all that the actuators move."""
    joints = [joint.name for leg in model.known.robot.legs for joint in leg.chain.joints]
    rubbing = [
        (one, value) for one, value in zip(model.terms, found.dynamics.values[model.inertial :])
        if one.form.dissipative and value != 0.0 and one.joint is not None
    ]  # fmt: skip
    taken, moved = np.zeros(len(joints)), 0.0
    for case in cases:
        every = max(1, len(case.motion) // (10 * FEW))
        q, v, a = (getattr(case.motion, key)[::every] for key in "qva")
        motion, target = model.moved(q, v, a), case.target[::every]
        if case.torque_rows.name == PLATFORM:
            target = target * motion.rate
        elif target.shape[1] == model.n:
            target = target * v
        moved += np.abs(target.sum(axis=1)).sum()
        for one, value in rubbing:
            speed = motion.v[:, one.joint]
            size = one.settings[0] if one.shape == "sign" else 0.0
            taken[one.joint] += value * np.sum(speed * (np.tanh(speed / max(size, 1e-9)) if size else speed))
    return tuple(name for name, own in zip(joints, taken) if own < DRIVEN * moved)


def _refuse(settings: IdentificationSettings, options: IdentifyOptions) -> None:
    """Refuse what the identification of serial arms knows and this one does not."""
    read = {each.name for each in fields(settings)} - OF_ARMS
    refuse_unread(settings, IdentificationSettings(), read, options.source)
    read = {each.name for each in fields(options)} - {"gain_pair", "cut_slow"}
    refuse_unread(options, IdentifyOptions(), read, options.source)
    if settings.friction not in ("auto", "standard"):
        raise UsageError(f"friction = '{settings.friction}': a parallel robot has standard friction only (Fv Fc off)")
    method = method_named(settings.method)
    if _of_arms(method):
        what = "simulates" if method.needs_simulation else "differentiates the torques of"
        known = ", ".join(name for name, one in METHODS.items() if not _of_arms(one))
        raise UsageError(f"method '{method.name}' {what} a serial arm; parallel robots take {known}")


def _of_arms(method: Method) -> bool:
    """Tell whether a method needs what only a serial arm's model has."""
    return method.needs_simulation or method.name == "ml"


def _errors(one: Score) -> dict[str, Any]:
    return {
        key: {
            "relative_error_percent": {"total": finite(part.total), "rows": [finite(x) for x in part.joints]},
            "rms": [finite(x) for x in part.rms],
        }
        for key, part in (("raw", one.raw), ("filtered", one.filtered))
    }


def _recording_notes(model: ParallelModel, cases: Sequence[Case]) -> list[str]:
    """Return how the files were understood, and what they hold that takes no part."""
    robot, notes = model.known.robot, []
    passive = [joint.name for leg in robot.legs for joint in leg.chain.joints if joint.name not in robot.joint_names]
    for case in cases:
        notes += [f"{case.name}: {note}" for note in case.motion.notes]
        unread = " ".join(note for note in case.motion.notes if note.startswith("not read: "))
        if named := [name for name in passive if name in unread]:
            notes.append(
                f"{case.name}: {', '.join(named)} are passive joints: their encoders and torques take no part, the "
                "loops say how they move"
            )
    return notes


def _contradictions(model: ParallelModel, cases: Sequence[Case]) -> list[str]:
    """Return whether redundant encoders agree."""
    robot, notes = model.known.robot, []
    for case in cases if robot.redundant else ():
        q = case.motion.q[:: max(1, len(case.motion) // FEW)]
        apart = float(np.sqrt(np.mean((q - model.known.locate(q).q[:, robot.actuated]) ** 2)))
        if apart > APART:
            notes.append(
                f"{case.name}: the {robot.n} encoders contradict each other by {1e3 * apart:.3g} mrad (or mm) rms: "
                "zeros or geometry are off; fit them first: calib fit on the same readings"
            )
    return notes


def _payload_notes(model: ParallelModel, found: Identification[Any], cases: Sequence[Case]) -> list[str]:
    """Return what recordings with and without them tell of the payloads."""
    notes, estimate = [], found.fitted.estimate
    for label in model.payloads:
        on = sum(label in case.carried for case in cases)
        if on == 0:
            notes.append(f"payload '{label}' is on board of no recording to learn from: nothing is known of it")
        elif on == len(cases):
            notes.append(
                f"payload '{label}' is on board of every recording: its parameters are regrouped with the platform's; "
                "a run without it tells them apart"
            )
        elif f"M{label}" in found.base.names:
            k = found.base.names.index(f"M{label}")
            mass, sigma = estimate.values[k], estimate.sigma[k]
            if mass < 3.0 * sigma:
                notes.append(
                    f"payload '{label}': {mass:.3g} ± {sigma:.2g} kg: the recordings said to carry it move as if it "
                    "were not there"
                )
    return notes


def _redundancy_notes(model: ParallelModel) -> list[str]:
    robot = model.known.robot
    if not robot.redundant:
        return []
    return [
        f"{robot.n} actuators for {robot.r} freedoms: torques were projected on the platform's coordinates, the "
        "overconstraint takes no part"
    ]
