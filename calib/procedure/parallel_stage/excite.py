"""Design an exciting motion of a parallel robot as the command does."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from calib.errors import RobotError, UsageError
from calib.identification.model_file import MODEL
from calib.mechanism.parallel_model import ParallelModel, make_parallel_model
from calib.procedure.excitation.parallel import ParallelDesign, design_parallel
from calib.procedure.excitation.settings import DEFAULT_DESIGN, ExcitationSettings
from calib.procedure.parallel_stage.robots import FoundRobot

GUARD = 0.2  # share of the torque limits kept free, where friction is not known (our choice)
_NOT_YET = ("goals", "hard", "family", "front", "start", "repeat", "slower", "existing", "lock")


def excite_parallel(
    robot: FoundRobot,
    settings: ExcitationSettings,
    *,
    model: Path | None = None,
    limits: Path | None = None,
    map: Callable = map,
    progress: Callable[[str], None] | None = None,
) -> ParallelDesign:
    """Design a motion that excites a parallel robot within the torque limits and platform box of its file.

    Args:
        settings: period, harmonics, drives, starts, evaluations, seed, rate; the others are for serial arms.
        model: folder of an identification of the same robot, which predicts the torques; None: the file's inertias.

    Raises:
        UsageError: for options that only serial arms know.
    """
    for key in _NOT_YET:
        if getattr(settings, key) != getattr(DEFAULT_DESIGN, key):
            raise UsageError(f"--{key} is for serial arms yet, not for parallel robots")
    if limits is not None:
        raise UsageError(
            "--limits is for serial arms yet; a parallel robot's are in its own file: effort, lower, upper"
        )
    say = progress or (lambda words: None)
    made = make_parallel_model(robot.known, (settings.drives,), v0=0.05)
    values = _values(made) if model is None else read_values(made, model)
    return design_parallel(
        made, settings, values=values, margin=GUARD, index="logdet", map=map,
        report=lambda done, total, what: say(f"{what} ({done} of {total})"),
    )  # fmt: skip


def read_values(model: ParallelModel, folder: Path) -> np.ndarray:
    """Return the values (p,) that an identification left in `folder`, zero for parameters it does not have.

    Raises:
        RobotError: where the folder holds no model, or one of other bodies.
    """
    path = folder / MODEL
    try:
        table = json.loads(path.read_text(encoding="utf-8"))["values"]
        values = np.array([float(table.get(name, 0.0)) for name in model.names])
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise RobotError(
            f"{path} holds no model of a parallel robot ({error!r}); give a folder of calib identify"
        ) from error
    if missing := [name for name in model.names[: model.inertial] if name not in table]:
        raise RobotError(f"{path} is of another robot: it has no {missing[0]}")
    return values


def _values(model: ParallelModel) -> np.ndarray | None:
    bodies = model.known_parameters()
    return None if bodies is None else np.concatenate([bodies, np.zeros(model.p - model.inertial)])
