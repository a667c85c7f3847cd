"""Learning curves: error on other motion against the seconds learnt from, of the toolkit and of plain references.

    CALIB_DATA=$D python examples/learning_at_work.py [ROBOT …]

Columns, each a model of the first seconds of a recording, judged on motion of which nothing was learnt [% of torque]:

* identify: `calib identify` on all seconds (prior by evidence, friction by held-out time);
* update: identified from the first row's seconds, then `calib update` with the seconds of one further row at a time;
* LS: weighted least squares of base parameters and standard friction, minimum norm where they are not identifiable;
* ridge: the same with one ridge for columns of unit norm, its size by evidence (MacKay 1992);
* DREM: dynamic regressor extension and mixing (Aranovskiy, Bobtsov, Ortega and Pyrkin 2017) with Kreisselmeier's
  filter (1977): dΦ/dt = -l Φ + WᵀW, dY/dt = -l Y + Wᵀy, dθ/dt = γ Δ (adj(Φ) Y - Δ θ), Δ = det Φ. For γ → ∞ the
  estimate is Φ⁻¹ Y once Δ differs from zero by more than rounding, and its start, zero, before.
"""

import argparse
import os
import tempfile
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np

import calib
from calib.apps.monitoring.learning.update import update_dynamics
from calib.apps.monitoring.learning.working_state import WorkingState
from calib.identification.identify import Identification, identify
from calib.identification.identify_options import parse_options
from calib.identification.prediction import Dynamics, predict, score
from calib.identification.rows import Case, pool, triangulate
from calib.procedure.dynamic_stage.inputs import gather

DATA = Path(os.environ.get("CALIB_DATA", "../shared/data"))
FORGETTING = 0.02
"""l of Kreisselmeier's filter [1/s]."""
RESOLVED = 1e-12
"""Ratio of the singular values of Φ, with columns of unit norm, above which Δ is not rounding."""
RIDGES = np.logspace(-10.0, 2.0, 121)
GAINS = "gains = [14.87, 13.26, 11.13, 10.62, 11.03, 11.47]\n"
WRIST = '[[coupling]]\njoints = [5, 6]\nlabel = "6"\n'
UR10E = "ur10e_innopolis/ur-20_0"
CURVES = {  # recording to learn from, start [s], seconds, other motion, options
    "UR10e": (f"{UR10E}2_10-30sec_12harm.npz", 8.0, (2, 4, 8, 16, 22), f"{UR10E}2_19_14harm50sec.npz", GAINS),
    "UR10e (2)": (f"{UR10E}2_19_14harm50sec.npz", 5.0, (2, 4, 8, 16, 40), f"{UR10E}2_10-30sec_12harm.npz", GAINS),
    "Panda": ("franka_panda_inria/traj1_first60pct.npz", 0.0, (1, 2, 4, 6, 9.387), "@9.387:11.9", ""),
    "KR300": ("kuka_kr300_tuk/traj_A.npz", 0.0, (4, 6, 8, 10), "kuka_kr300_tuk/traj_B.npz", ""),
    "KR300 (2)": ("kuka_kr300_tuk/traj_B.npz", 0.0, (4, 6, 8, 10), "kuka_kr300_tuk/traj_A.npz", ""),
    "TX40": ("staubli_tx40/tx40_first_5p4s.npz", 0.0, (0.7, 1, 1.5, 2, 2.7), "@2.7:", WRIST),
    "LWR4+": ("kuka_lwr4plus_iit/measurements_1.npz", 2.5, (3, 4.5, 6.25), "@8.75:15", ""),
    "TIAGo": ("tiago_laas/dynamic.npz", 0.0, (5, 10, 25, 50), "@50:", ""),
}


def error(dynamics: Dynamics, case: Case) -> float:
    """Return the share of a case's torque that a model leaves unexplained [%]."""
    return score(case, predict(dynamics, case)).raw.total


def updated_error(state: WorkingState, case: Case) -> float:
    """Return the same of an updated model, gains included."""
    changes, _ = state.bank.posterior()
    torque = predict(state.model.updated(changes), case)
    torque += predict(state.model.dynamics, case) * changes[state.model.k :]
    return score(case, torque).raw.total


def plain_models(found: Identification) -> dict[str, Dynamics]:
    """Return the models of the plain references, by name, from the rows of an identification with standard friction."""
    base = found.base
    rows = found.rows
    data = pool(triangulate(rows), rows[0].target.shape[1])
    assert found.prior is not None
    std = found.prior.first.std
    stacked = (data.factors / std[:, None, None]).reshape(-1, data.parameters + 1)
    norms = np.linalg.norm(stacked[:, :-1], axis=0)
    norms[norms == 0.0] = 1.0
    left, singular, right = np.linalg.svd(stacked[:, :-1] / norms, full_matrices=False)
    target = left.T @ stacked[:, -1]
    resolved = singular > 1e-10 * singular[0]
    solution = np.where(resolved, target / np.where(resolved, singular, 1.0), 0.0)
    squares = float(stacked[:, -1] @ stacked[:, -1])
    count = int(data.rows.sum())
    best, best_evidence = np.zeros_like(solution), -np.inf
    for ratio in RIDGES:
        size = ratio * singular[0] ** 2
        denominator = singular**2 + size
        residual = squares - np.sum(singular**2 / denominator * target**2)
        evidence = -0.5 * count * np.log(residual / count) - 0.5 * np.sum(np.log(denominator / size))
        if evidence > best_evidence:
            best, best_evidence = singular * target / denominator, evidence
    values = {"LS": right.T @ solution / norms, "ridge": right.T @ best / norms, "DREM": mixed(found, std, norms)}
    models = {}
    for name, x in values.items():
        models[name] = Dynamics(found.dynamics.model, np.concatenate([base.to_standard(x[: base.b]), x[base.b :]]))
    return models


def mixed(found: Identification, std: np.ndarray, norms: np.ndarray) -> np.ndarray:
    """Return the parameters (p,) by DREM with Kreisselmeier's filter, sample by sample.

    Args:
        found: an identification, whose rows are used.
        std: (rows,) standard deviations that rows are divided by.
        norms: (p,) norms that columns are divided by.
    """
    extended = np.zeros((len(norms), len(norms)))
    output = np.zeros(len(norms))
    for rows in found.rows:
        decay = np.exp(-FORGETTING / rows.rate)
        for matrix, target, weight in zip(rows.matrix, rows.target, rows.weight):
            regressor = matrix / norms * (weight / std)[:, None]
            extended = decay * extended + regressor.T @ regressor
            output = decay * output + regressor.T @ (target * weight / std)
    singular = np.linalg.svd(extended, compute_uv=False)
    if singular[-1] < RESOLVED * singular[0]:
        return np.zeros(len(norms))
    return np.linalg.solve(extended, output) / norms


def curve(robot: str) -> list[dict[str, float]]:
    """Return the errors [%] of all models of a robot, one row per length learnt from."""
    log, start, lengths, other, options_text = CURVES[robot]
    recording = DATA / log
    unseen = DATA / other if not other.startswith("@") else f"{recording}{other}"
    urdf = recording.parent / "model.urdf"
    table = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        options = folder / "options.toml"
        options.write_text(options_text)
        parsed = parse_options(tomllib.loads(options_text))
        state_folder = folder / "0"
        for k, seconds in enumerate(lengths):
            inputs = gather(urdf, [f"{recording}@{start:g}:{start + seconds:g}"], [str(unseen)], options=parsed)
            case = inputs.unseen[0]
            whole = identify(inputs.robot, inputs.cases, inputs.options.settings)
            standard = replace(inputs.options.settings, friction="standard")
            row = {"seconds": seconds, "identify": error(whole.dynamics, case)}
            if k == 0:
                first = calib.identify_dynamics(urdf, f"{recording}@{start:g}:{start + seconds:g}", options=options)
                first.save(state_folder, plots=False)
                row["update"] = row["identify"]
            else:
                piece = f"{recording}@{start + lengths[k - 1]:g}:{start + seconds:g}"
                update = update_dynamics(state_folder, [piece], options=options)
                row["update"] = updated_error(update.state, case)
                state_folder = update.save(folder / f"{k}", plots=False)
            for model, dynamics in plain_models(identify(inputs.robot, inputs.cases, standard)).items():
                row[model] = error(dynamics, case)
            table.append(row)
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("robots", nargs="*", default=list(CURVES))
    print("| robot | s | identify | update | LS | ridge | DREM | best / best reference |")
    print("|---|---|---|---|---|---|---|---|")
    for robot in parser.parse_args().robots:
        for row in curve(robot):
            cells = [f"{row[name]:.4g}" for name in ("seconds", "identify", "update", "LS", "ridge", "DREM")]
            reference = min(row["LS"], row["ridge"], row["DREM"])
            ratios = [f"{row[name] / reference:.2f}" for name in ("identify", "update")]
            print(f"| {robot} | {' | '.join(cells)} | {', '.join(ratios)} |", flush=True)


if __name__ == "__main__":
    main()
