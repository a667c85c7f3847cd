"""An identified model held against recordings it has not seen, and judged; what the certificate needs of it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calib import files
from calib.errors import UsageError
from calib.identification.cases import Case
from calib.identification.model_file import read_dynamics
from calib.procedure.dynamic_stage.folder import score_table, write_torques
from calib.procedure.dynamic_stage.identify import Assessment, IdentificationInputs, assess
from calib.procedure.dynamic_stage.verdict import Resting

SCHEMA = 1
POINTS = 400  # samples per curve of the certificate (our choice)


@dataclass(frozen=True, eq=False)
class Held:
    """A model on unseen motion: the recordings, and what it comes to on them."""

    inputs: IdentificationInputs
    result: Assessment


def hold(inputs: IdentificationInputs, folder: Path, tolerance: float = 0.0) -> Held:
    """Predict every recording by the model that an identification left in `folder`, and judge.

    Args:
        inputs: recordings to learn from (for the model's own error) and unseen ones.
        tolerance: largest error of the torque on unseen motion that is good enough [%]; 0: none.

    Raises:
        RobotError: where the folder holds no model.
        UsageError: where its ``metrics.json`` is missing or damaged.
    """
    _, dynamics = read_dynamics(folder)
    try:
        metrics = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
        known = metrics.get("resting", {})  # an older version does not say it: its warnings do
        rests = Resting(tuple(known.get("names", ())), known.get("of", 0), known.get("source", ""))
        said = metrics["warnings"]
    except (OSError, ValueError, KeyError) as error:
        raise UsageError(f"{folder}/metrics.json: {error!r}; identify again") from error
    return Held(inputs, assess(inputs, dynamics, rests, said, tolerance=tolerance))


def write(held: Held, folder: Path) -> None:
    """Write ``report.json`` (scores, verdict, curves for the certificate) and a table of unseen torques per file."""
    for number, case in enumerate(held.inputs.unseen, 1):
        write_torques(case, held.result.predictions[case.name], folder / f"torques_{number}.csv")
    files.write_json(folder / "report.json", report(held))


def report(held: Held) -> dict[str, Any]:
    """Return scores, verdict and curves as JSON holds them."""
    chain, rows, found = held.inputs.chain, held.inputs.options.settings.torque_rows, held.result
    return {
        "schema": SCHEMA,
        "verdict": found.verdict.level,
        "reason": found.verdict.reason,
        "warnings": list(found.warnings),
        "rows": list(rows.titles(chain.joint_names)),
        "units": list(rows.units([joint.kind == "prismatic" for joint in chain.joints])),
        "fit": {name: score_table(one) for name, one in found.fit.items()},
        "validation": {
            name: score_table(one) | {"evidence": name not in found.repeated} for name, one in found.validation.items()
        },
        "curves": [_curves(case, found.predictions[case.name]) for case in (held.inputs.unseen or held.inputs.cases)],
        "autocorrelation": {
            name: {
                "bound": [None if w is None else w.bound for w in one.whiteness],
                "values": [None if w is None else [round(float(x), 4) for x in w.acf] for w in one.whiteness],
            }
            for name, one in (found.validation or found.fit).items()
        },
    }


def _curves(case: Case, predicted: np.ndarray) -> dict[str, Any]:
    """Return measured and predicted torques, thinned for drawing."""
    picked = np.unique(np.linspace(0, len(case.target) - 1, POINTS).astype(int))
    plain = lambda x: [[float(f"{value:.5g}") for value in column] for column in np.asarray(x)[picked].T]  # noqa: E731
    return {
        "name": case.name,
        "t": [round(float(t), 4) for t in case.motion.t[picked]],
        "measured": plain(case.target),
        "predicted": plain(predicted),
    }
