"""Design an exciting motion of a parallel robot as the command does."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from calib import files
from calib.dynamics.shapes import V0
from calib.errors import RobotError, UsageError
from calib.identification.model_file import MODEL
from calib.procedure.excitation import coefficients
from calib.procedure.excitation.coefficients import PLANNED
from calib.procedure.excitation.settings import DEFAULT_DESIGN, ExcitationSettings
from calib.procedure.robot_kinds import refuse_unread
from calib.robot.calibrated import ROBOT
from calib.robot.tables import dumps
from calib.rooms.parallel.design import ParallelDesign, design_parallel
from calib.rooms.parallel.mechanism.parallel_model import ParallelModel, make_parallel_model
from calib.rooms.parallel.results import ParallelResult, ResultFolder, write_motion
from calib.rooms.parallel.robots import ParallelMechanism
from trajectories.setpoints import Setpoints

DRIVES = ("Ia", "Fv", "Fc", "off")
GUARD = 0.2  # share of the torque limits kept free, where friction is not known (our choice)
READ = ("period", "harmonics", "drives", "starts", "evaluations", "seed", "rate")  # of the settings
EXACT = 1e-8  # by which the series of the actuators may leave the motion [rad or m]
HARMONIC_SAMPLES = 2048  # over the period, of which the actuators' series are made


@dataclass(frozen=True, eq=False, repr=False)
class ParallelExcitation(ParallelResult):
    """An exciting motion of a parallel robot: what `calib.design_excitation` returns of one.

    Attributes:
        robot: with its file.
        designed: the motion and its proof.
        rate: of the controller [Hz].
    """

    robot: ParallelMechanism
    designed: ParallelDesign
    rate: float
    folder: ClassVar = ResultFolder((PLANNED, coefficients.NAME), (PLANNED,), "motion")

    def write(self, folder: Path, plots: bool) -> None:
        """Write one period at the controller's rate, and the actuators' series."""
        design, own = self.designed, self.robot.known.robot.actuated
        t = np.arange(round(design.family.period * self.rate) + 1) / self.rate
        orders, motion = design.orders(t), design.along(t)
        tau = None if design.robot.values is None else design.robot.torques(*orders)
        track = Setpoints(self.rate, motion.posture.q[:, own], motion.v[:, own], motion.a[:, own], tau)
        write_motion(self.robot, design.bounds, track, orders[0], folder)
        series = coefficients.table(_actuators_series(design, self.rate), ROBOT, design.bounds.lines())
        files.write(folder / coefficients.NAME, dumps(series))

    def to_dict(self) -> dict[str, Any]:
        """Return the metrics as ``metrics.json`` holds them."""
        design = self.designed
        return {
            "robot": self.robot.known.robot.name,
            "period": design.family.period,
            "parameters": list(design.base.names),
            "condition_number": {key: float(value) for key, value in design.condition.items()},
            "peak_torque": None if design.peak is None else design.peak.tolist(),
            "peak_acceleration": design.fastest.tolist(),
            "margins": [
                {"limit": one.name, "of": one.label, "margin": float(one.margin), "unit": one.unit}
                for one in design.proof.margins
            ],
            "limits": design.bounds.lines(),
        }

    def lines(self) -> list[str]:
        """Return what the command prints."""
        design, robot = self.designed, self.robot.known.robot
        lines = [
            f"{robot.name}: {design.family.period:g} s, condition number {design.condition['raw']:.4g}, with columns "
            f"of unit norm {design.condition['normalised']:.4g}, of {len(design.base.names)} base parameters"
        ]
        if design.peak is not None:
            pairs = zip(robot.joint_names, design.peak)
            lines.append("peak torques: " + ", ".join(f"{name} {peak:.3g}" for name, peak in pairs))
        worst = min(design.proof.margins, key=lambda one: one.share)
        label = worst.label
        for k, name in enumerate(robot.freedom if worst.name in ("position", "acceleration") else ()):
            label = label.replace(f"joint {k + 1} ", f"platform {name} ")
        closest = f"closest limit: {worst.name} of {label}, {worst.margin:.3g} {worst.unit} left"
        return [*lines, closest, *design.bounds.lines()]

    def __repr__(self) -> str:
        return f"<ParallelExcitation for {self.robot.known.robot.name}: {self.designed.family.period:g} s>"


def excite_parallel(
    robot: ParallelMechanism,
    settings: ExcitationSettings,
    *,
    model: Path | None = None,
    limits: Path | None = None,
    map: Callable = map,
    progress: Callable[[str], None] | None = None,
) -> ParallelExcitation:
    """Design a motion that excites a parallel robot within the torque limits and platform box of its file.

    Args:
        settings: period, harmonics, drives, starts, evaluations, seed, rate; the others are for serial arms.
        model: folder of an identification of the same robot, which predicts the torques and whose drive terms are to
            be told; None: the file's inertias.

    Raises:
        UsageError: for options that only serial arms know.
    """
    refuse_unread(settings, DEFAULT_DESIGN, READ)
    if limits is not None:
        raise UsageError("limits are for serial arms yet; a parallel robot's are in its own file: effort, lower, upper")
    say = progress or (lambda words: None)
    if model is None:
        made = make_parallel_model(robot.known, (settings.drives,), v0=0.05)
        values = _values(made)
    else:
        made, values = read_model(robot, model)
    designed = design_parallel(
        made, settings, values=values, margin=GUARD, index="logdet", map=map,
        report=lambda done, total, what: say(f"{what} ({done} of {total})"),
    )  # fmt: skip
    return ParallelExcitation(robot, designed, settings.rate)


def read_model(robot: ParallelMechanism, folder: Path) -> tuple[ParallelModel, np.ndarray]:
    """Return the model that an identification left in `folder`, on the robot's loops, with its values (p,).

    Raises:
        RobotError: where the folder holds no model, or one of other bodies.
    """
    path, tree = folder / MODEL, robot.known.robot
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
        known = {str(name): float(value) for name, value in table["values"].items()}
        texts = [" ".join(one for one in DRIVES if one + label in known) for label in tree.labels]
        passive = next((text for j, text in enumerate(texts) if j not in tree.actuated and text), "")
        model = make_parallel_model(
            robot.known, [texts[j] for j in tree.actuated], v0=float(table.get("v0", V0)),
            payloads=[str(label) for label in table.get("payloads", ())], passive=passive,
        )  # fmt: skip
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise RobotError(
            f"{path} holds no model of a parallel robot ({error!r}); give a folder of calib identify"
        ) from error
    if missing := [name for name in model.names[: model.inertial] if name not in known]:
        raise RobotError(f"{path} is of another robot: it has no {missing[0]}")
    return model, np.array([known.get(name, 0.0) for name in model.names])


def _values(model: ParallelModel) -> np.ndarray | None:
    bodies = model.known_parameters()
    return None if bodies is None else np.concatenate([bodies, np.zeros(model.p - model.inertial)])


def _actuators_series(design: ParallelDesign, rate: float) -> coefficients.Periodic:
    """Return the periodic motion of the actuators as Fourier series, long enough to be exact within `EXACT`."""
    known, period = design.robot.model.known, design.family.period
    times = period / HARMONIC_SAMPLES * np.arange(HARMONIC_SAMPLES)
    lines = np.fft.rfft(design.along(times).posture.q[:, known.robot.actuated], axis=0) / HARMONIC_SAMPLES
    above = np.cumsum(2.0 * np.abs(lines[::-1]), axis=0)[::-1].max(axis=1)
    last = 1 + max(1, int((above[1:] > EXACT).sum()))
    own = tuple(np.concatenate([[c[0].real], -2.0 * c[1:last].imag, 2.0 * c[1:last].real]) for c in lines.T)
    return coefficients.Periodic(known.robot.joint_names, period, rate, 1, "fourier", own)
