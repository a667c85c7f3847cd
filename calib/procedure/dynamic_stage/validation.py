"""An identified model held against recordings it has not seen, and judged; what the certificate needs of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from calib import files
from calib.data.signals.persistency import repeats, report_excitation
from calib.identification.cases import Case, row_labels
from calib.identification.model_file import read_dynamics
from calib.identification.prediction import predict
from calib.identification.scores import Score, score
from calib.procedure.dynamic_stage.folder import score_table, write_torques
from calib.procedure.dynamic_stage.identify import REPEAT, IdentificationInputs
from calib.procedure.dynamic_stage.verdict import judge
from calib.procedure.kinematic_stage.verdict import Verdict

SCHEMA = 1
POINTS = 400  # samples per curve of the certificate (our choice)


@dataclass(frozen=True, eq=False)
class Held:
    """A model on unseen motion.

    Attributes:
        inputs: the recordings.
        fit, validation: case name → its score.
        predictions: case name → torques (N, rows) by the model.
        repeated: validation case → share of its states that training has been in, where that makes it no proof.
        verdict: of the dynamics.
        warnings: what a user should know.
    """

    inputs: IdentificationInputs
    fit: Mapping[str, Score]
    validation: Mapping[str, Score]
    predictions: Mapping[str, np.ndarray]
    repeated: Mapping[str, float]
    verdict: Verdict
    warnings: tuple[str, ...]


def hold(inputs: IdentificationInputs, folder: Path, tolerance: float = 0.0) -> Held:
    """Predict every recording by the model that an identification left in `folder`, and judge.

    Args:
        inputs: recordings to learn from (for the model's own error) and unseen ones.
        tolerance: largest error of the torque on unseen motion that is good enough [%]; 0: none.
    """
    _, dynamics = read_dynamics(folder)
    predictions, scores = {}, {}
    for case in (*inputs.cases, *inputs.unseen):
        predictions[case.name] = predict(dynamics, case)
        scores[case.name] = score(case, predictions[case.name], inputs.options.slow)
    shares = {case.name: max(repeats(own.motion, case.motion) for own in inputs.cases) for case in inputs.unseen}
    repeated = {name: share for name, share in shares.items() if share >= REPEAT}
    fit = {case.name: scores[case.name] for case in inputs.cases}
    validation = {case.name: scores[case.name] for case in inputs.unseen}
    proofs = {name: one for name, one in validation.items() if name not in repeated}
    excitation = {case.name: report_excitation(case.motion) for case in inputs.cases}
    labels = row_labels(inputs.options.settings.kind, inputs.chain.n)
    verdict = tolerated(judge(fit, proofs, repeated, excitation, rows=labels), proofs, tolerance)
    told = tuple(
        f"{name}: {100 * share:.0f} % of its states were met in training: a repeat proves nothing, it is no evidence"
        for name, share in repeated.items()
    )
    return Held(inputs, fit, validation, predictions, repeated, verdict, told)


def tolerated(verdict: Verdict, proofs: Mapping[str, Score], tolerance: float) -> Verdict:
    """Return the verdict, made to fail where the tolerance [%] is not kept."""
    worst = max((one.raw.total for one in proofs.values()), default=0.0)
    if not tolerance or worst <= tolerance:
        return verdict
    return replace(verdict, level="fail", reason=f"{verdict.reason}; above the tolerance of {tolerance:g} %")


def write(held: Held, folder: Path) -> None:
    """Write ``report.json`` (scores, verdict, curves for the certificate) and a table of unseen torques per file."""
    for number, case in enumerate(held.inputs.unseen, 1):
        write_torques(case, held.predictions[case.name], folder / f"torques_{number}.csv")
    files.write_json(folder / "report.json", report(held))


def report(held: Held) -> dict[str, Any]:
    """Return scores, verdict and curves as JSON holds them."""
    chain, kind = held.inputs.chain, held.inputs.options.settings.kind
    return {
        "schema": SCHEMA,
        "verdict": held.verdict.level,
        "reason": held.verdict.reason,
        "warnings": list(held.warnings),
        "rows": row_names(chain.joint_names, kind),
        "units": ["N" if joint.kind == "prismatic" else "N m" for joint in chain.joints] * (2 if kind == "both" else 1),
        "fit": {name: score_table(one) for name, one in held.fit.items()},
        "validation": {
            name: score_table(one) | {"evidence": name not in held.repeated} for name, one in held.validation.items()
        },
        "curves": [_curves(case, held.predictions[case.name]) for case in (held.inputs.unseen or held.inputs.cases)],
        "autocorrelation": {
            name: {
                "bound": [None if w is None else w.bound for w in one.whiteness],
                "values": [None if w is None else [round(float(x), 4) for x in w.acf] for w in one.whiteness],
            }
            for name, one in (held.validation or held.fit).items()
        },
    }


def row_names(joints: tuple[str, ...], kind: str) -> list[str]:
    """Return what the torque rows are called."""
    sensors = [f"{name} sensor" for name in joints]
    motors = [f"{name} motor" for name in joints]
    return {"both": sensors + motors, "link": sensors}.get(kind, list(joints))


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
