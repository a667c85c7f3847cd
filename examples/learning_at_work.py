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
from collections.abc import Iterator
from dataclasses import dataclass, replace
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
FORGETTING = 0.02  # l of Kreisselmeier's filter [1/s]
# singular values of Φ, with columns of unit norm, as shares of the largest, above which Δ is no rounding
RESOLVED = 1e-12
IDENTIFIABLE = 1e-10  # the same of the observation matrix, for least squares
RIDGES = np.logspace(-10.0, 2.0, 121)
REFERENCES = ("LS", "ridge", "DREM")
GAINS = "gains = [14.87, 13.26, 11.13, 10.62, 11.03, 11.47]\n"
WRIST = '[[coupling]]\njoints = [5, 6]\nlabel = "6"\n'


@dataclass(frozen=True)
class Curve:
    """A recording to learn from and another motion to predict.

    Attributes:
        recording: to learn from, below `DATA`.
        start: from when on [s].
        lengths: seconds that are learnt from, a row each.
        unseen: recording to predict, below `DATA`; "@from:to" is a part of the same one.
        options: text of the options file.
    """

    recording: str
    start: float
    lengths: tuple[float, ...]
    unseen: str
    options: str = ""

    def part(self, begin: float, end: float) -> str:
        """Return the recording between two instants [s] after the start, as `calib identify` takes it."""
        return f"{DATA / self.recording}@{self.start + begin:g}:{self.start + end:g}"


UR10E_12 = "ur10e_innopolis/ur-20_02_10-30sec_12harm.npz"
UR10E_14 = "ur10e_innopolis/ur-20_02_19_14harm50sec.npz"
PANDA = "franka_panda_inria/traj1_first60pct.npz"
KR300_A = "kuka_kr300_tuk/traj_A.npz"
KR300_B = "kuka_kr300_tuk/traj_B.npz"
CURVES = {
    "UR10e": Curve(UR10E_12, 8.0, (2, 4, 8, 16, 22), UR10E_14, GAINS),
    "UR10e (2)": Curve(UR10E_14, 5.0, (2, 4, 8, 16, 40), UR10E_12, GAINS),
    "Panda": Curve(PANDA, 0.0, (1, 2, 4, 6, 9.387), "@9.387:11.9"),
    "KR300": Curve(KR300_A, 0.0, (4, 6, 8, 10), KR300_B),
    "KR300 (2)": Curve(KR300_B, 0.0, (4, 6, 8, 10), KR300_A),
    "TX40": Curve("staubli_tx40/tx40_first_5p4s.npz", 0.0, (0.7, 1, 1.5, 2, 2.7), "@2.7:", WRIST),
    "LWR4+": Curve("kuka_lwr4plus_iit/measurements_1.npz", 2.5, (3, 4.5, 6.25), "@8.75:15"),
    "TIAGo": Curve("tiago_laas/dynamic.npz", 0.0, (5, 10, 25, 50), "@50:"),
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


def reference_models(identification: Identification) -> dict[str, Dynamics]:
    """Return the models of the plain references, by name, from the rows of an identification with standard friction."""
    assert identification.prior is not None
    base = identification.base
    std = identification.prior.first.std
    data = pool(triangulate(identification.rows), identification.rows[0].target.shape[1])
    # rows divided by their standard deviations, columns by their norms: W x = y
    whitened = (data.factors / std[:, None, None]).reshape(-1, data.parameters + 1)
    w, y = whitened[:, :-1], whitened[:, -1]
    norms = np.linalg.norm(w, axis=0)
    norms[norms == 0.0] = 1.0
    solutions = {
        "LS": minimum_norm(w / norms, y) / norms,
        "ridge": ridge(w / norms, y, samples=int(data.rows.sum())) / norms,
        "DREM": mixed(identification, std, norms),
    }
    models = {}
    for name, x in solutions.items():
        parameters = np.concatenate([base.to_standard(x[: base.b]), x[base.b :]])
        models[name] = Dynamics(identification.dynamics.model, parameters)
    return models


def minimum_norm(w: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the least squares solution (p,) of w x = y of minimum norm, w (rows, p) with columns of unit norm."""
    u, singular, vt = np.linalg.svd(w, full_matrices=False)
    identifiable = singular > IDENTIFIABLE * singular[0]
    inverse = np.zeros_like(singular)
    inverse[identifiable] = 1.0 / singular[identifiable]
    return vt.T @ (u.T @ y * inverse)


def ridge(w: np.ndarray, y: np.ndarray, samples: int) -> np.ndarray:
    """Return the ridge solution (p,) of w x = y whose size of `RIDGES` has the largest evidence.

    Args:
        w: (rows, p) with columns of unit norm.
        y: (rows,).
        samples: number of samples that the rows stand for.
    """
    u, singular, vt = np.linalg.svd(w, full_matrices=False)
    target = u.T @ y
    squares = float(y @ y)
    best_evidence = -np.inf
    best_denominator = np.full_like(singular, np.inf)
    for ratio in RIDGES:
        size = ratio * singular[0] ** 2
        denominator = singular**2 + size
        residual = squares - np.sum(singular**2 / denominator * target**2)
        evidence = -0.5 * samples * np.log(residual / samples) - 0.5 * np.sum(np.log(denominator / size))
        if evidence > best_evidence:
            best_evidence = evidence
            best_denominator = denominator
    return vt.T @ (singular * target / best_denominator)


def mixed(identification: Identification, std: np.ndarray, norms: np.ndarray) -> np.ndarray:
    """Return the parameters (p,) by DREM with Kreisselmeier's filter, sample by sample.

    Args:
        identification: whose rows are used.
        std: (rows,) standard deviations that rows are divided by.
        norms: (p,) norms that columns are divided by.
    """
    extended = np.zeros((len(norms), len(norms)))
    output = np.zeros(len(norms))
    for rows in identification.rows:
        decay = np.exp(-FORGETTING / rows.rate)
        for matrix, target, weight in zip(rows.matrix, rows.target, rows.weight):
            regressor = matrix / norms * (weight / std)[:, None]
            extended = decay * extended + regressor.T @ regressor
            output = decay * output + regressor.T @ (target * weight / std)
    singular = np.linalg.svd(extended, compute_uv=False)
    if singular[-1] < RESOLVED * singular[0]:
        return np.zeros(len(norms))
    return np.linalg.solve(extended, output) / norms


def errors_by_length(robot: str) -> Iterator[dict[str, float]]:
    """Yield the errors [%] of all models of a robot, one row per length learnt from."""
    curve = CURVES[robot]
    recording = DATA / curve.recording
    urdf = recording.parent / "model.urdf"
    unseen = str(DATA / curve.unseen)
    if curve.unseen.startswith("@"):
        unseen = f"{recording}{curve.unseen}"
    parsed = parse_options(tomllib.loads(curve.options))
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        options = folder / "options.toml"
        options.write_text(curve.options)
        state_folder = folder / "0"
        for k, seconds in enumerate(curve.lengths):
            inputs = gather(urdf, [curve.part(0.0, seconds)], [unseen], options=parsed)
            settings = inputs.options.settings
            case = inputs.unseen[0]
            identification = identify(inputs.robot, inputs.cases, settings)
            row = {"seconds": seconds, "identify": error(identification.dynamics, case)}
            if k == 0:
                model = calib.identify_dynamics(urdf, curve.part(0.0, seconds), options=options)
                model.save(state_folder, plots=False)
                row["update"] = row["identify"]
            else:
                piece = curve.part(curve.lengths[k - 1], seconds)
                update = update_dynamics(state_folder, [piece], options=options)
                row["update"] = updated_error(update.state, case)
                state_folder = update.save(folder / f"{k}", plots=False)
            standard = identify(inputs.robot, inputs.cases, replace(settings, friction="standard"))
            for name, dynamics in reference_models(standard).items():
                row[name] = error(dynamics, case)
            yield row


def line(robot: str, row: dict[str, float]) -> str:
    """Return a line of the table."""
    columns = ("seconds", "identify", "update", *REFERENCES)
    cells = [robot, *(f"{row[name]:.4g}" for name in columns)]
    best = min(row[name] for name in REFERENCES)
    cells.append(f"{row['identify'] / best:.2f}, {row['update'] / best:.2f}")
    return f"| {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("robots", nargs="*", default=list(CURVES))
    robots = parser.parse_args().robots
    print("| robot | s | identify | update | LS | ridge | DREM | identify, update / best reference |")
    print("|---|---|---|---|---|---|---|---|")
    for robot in robots:
        for row in errors_by_length(robot):
            print(line(robot, row), flush=True)


if __name__ == "__main__":
    main()
