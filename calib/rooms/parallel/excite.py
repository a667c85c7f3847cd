"""Design an exciting motion of a parallel robot as the command does."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from calib.dynamics.shapes import V0
from calib.errors import RobotError, UsageError
from calib.identification.model_file import MODEL
from calib.procedure.excitation.settings import DEFAULT_DESIGN, ExcitationSettings
from calib.rooms.parallel.design import ParallelDesign, design_parallel
from calib.rooms.parallel.mechanism.parallel_model import ParallelModel, make_parallel_model
from calib.rooms.parallel.robots import ParallelMechanism

DRIVES = ("Ia", "Fv", "Fc", "off")
GUARD = 0.2  # share of the torque limits kept free, where friction is not known (our choice)
_NOT_YET = ("goals", "hard", "family", "front", "start", "repeat", "slower", "existing", "lock")


def excite_parallel(
    robot: ParallelMechanism,
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
        model: folder of an identification of the same robot, which predicts the torques and whose drive terms are to
            be told; None: the file's inertias.

    Raises:
        UsageError: for options that only serial arms know.
    """
    for key in _NOT_YET:
        if getattr(settings, key) != getattr(DEFAULT_DESIGN, key):
            raise UsageError(f"{key} is for serial arms yet, not for parallel robots")
    if limits is not None:
        raise UsageError("limits are for serial arms yet; a parallel robot's are in its own file: effort, lower, upper")
    say = progress or (lambda words: None)
    if model is None:
        made = make_parallel_model(robot.known, (settings.drives,), v0=0.05)
        values = _values(made)
    else:
        made, values = read_model(robot, model)
    return design_parallel(
        made, settings, values=values, margin=GUARD, index="logdet", map=map,
        report=lambda done, total, what: say(f"{what} ({done} of {total})"),
    )  # fmt: skip


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
