"""The dynamic half of the LWR4+ study, scripted: Models 1 to 3, two loads, CAD geometry and that of geometry.py's fit.

Kolyubin, Shiriaev & Jubien (2019), Int. J. Adv. Manuf. Technol. 101, 243-259, sections 4 and 6.2, on a simulated arm:
the calibrated column of their Table 2, a 3.28 kg payload, joint torque sensors, 1 kHz, 10 Hz Butterworth, decimation to
2 Hz. *Calibrated* is the geometry fitted to 17 measured poses. The motion is Trajectory B of 44 columns, as
`excitation.py` designed it (``trajectory.toml``); torques are predicted on it again and on a random Fourier series of
25 s and five harmonics.

What is by construction: see `simulated_arm.py`. The counts, and which inertial parameters turn out essential, do not
depend on that. How many are essential depends on the noise and the rule: the paper supervised its rule by hand; here an
F-test, then whatever has an RSD above 10 % goes, and the paper's own ratio of RSDs is shown beside it.

    python examples/lwr4plus/dynamics.py --out lwr4plus-dynamics [--seed 0]
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import geometry
import numpy as np
import study_options
import study_tables
from excitation import RATE, trajectory_b
from matplotlib.figure import Figure
from simulated_arm import TABLE_4, Data, collected, controller, model, nominal_base, record, true_chain, true_parameters

from calib import files
from calib.dynamics import base as bases
from calib.dynamics.torque_rows import MODELS
from calib.estimation.essential import Elimination, Rule, eliminate
from calib.procedure.report.figures.sheets import save, sheet, styled
from calib.simulation import lwr4plus
from calib.toolkit.chains import Chain
from calib.toolkit.report_charts import AFTER, INK, PAGE_WIDTH, QUIET
from calib.toolkit.simulations import Plant, Reference, feed_forward, random_fourier, tracking_error
from calib.toolkit.statistics import LinearFit, settled_std, wls
from calib.toolkit.torque_models import BOTH, MOTOR, Base, IdentificationModel, TorqueRows, observe

# random motion for validation: shares of the joints' ranges [rad] and speeds [rad/s]; duration [s]; harmonics
REACH = 0.8 * np.deg2rad([170.0, 120.0, 170.0, 120.0, 170.0, 90.0, 170.0])
SPEED = 0.8 * np.deg2rad([110.0, 110.0, 128.0, 128.0, 204.0, 184.0, 184.0])
DURATION, HARMONICS = 25.0, 5
# gravity of a base that is tilted [m/s²]
TILTED_GRAVITY = 9.81 * np.array([0.3, 0.2, -np.sqrt(1 - 0.13)])
# error of joint 6 within which Fig. 8 stays "along most of the validation trajectory" [N m]
PAPER_JOINT_6 = 0.5
# level of the F-test; r_σ of the paper's rule; RSD [%] above which a parameter goes
LEVEL, RATIO, MAX_RSD = 0.01, 30.0, 10.0
# Jubien, Gautier & Janot (2014), another unit, by way of kukaKDL's kukakdl_const.hpp; ZZ2R there holds Ia2. Its motor
# inertias and friction are the truth here (by construction), so only the links' parameters are compared.
PUBLISHED = {"XX2R": 1.31, "ZZ2R + Ia2": 4.46, "MY2R": 3.37, "XX4R": 0.368, "MY4R": -1.37, "MY5R": 0.049, "MY6R": 0.042}


def counts() -> dict[str, int]:
    """Return the numbers of base parameters of the models and their variants, on the CAD geometry."""
    chain = lwr4plus.nominal_chain()
    both = model(chain, BOTH)
    tilted = model(chain, BOTH, TILTED_GRAVITY)
    base = nominal_base(BOTH)
    numbers = {f"Model {number}": nominal_base(kind).b for number, kind in MODELS.items()}
    return numbers | {
        "one load case": bases.find(both, loads=[None]).b,
        "motor torque only": nominal_base(MOTOR).b,
        "tilted": bases.find(tilted).b,
        "standard": both.p,
        "without effect": len(base.without_effect),
        "regrouped": len(base.regrouped),
    }


def fourier(seed: list[int]) -> Reference:
    """Return a random motion that no model is fitted to."""
    return random_fourier(-REACH, REACH, SPEED, DURATION, RATE, HARMONICS, seed=np.random.default_rng(seed))


@dataclass(frozen=True)
class Fit:
    """One model, identified on one geometry.

    Attributes:
        model: the model on that geometry.
        base: its base parameters.
        fit: estimate of all base parameters.
        elimination: the essential parameters with their estimate.
        rules: name of a rule of elimination to the number of parameters that it keeps.
    """

    model: IdentificationModel
    base: Base
    fit: LinearFit
    elimination: Elimination
    rules: dict[str, int]

    @property
    def values(self) -> np.ndarray:
        """All base parameters (b,): the essential estimate, and zero for the others."""
        values = np.zeros(self.base.b)
        values[self.elimination.kept] = self.elimination.essential.estimate.values
        return values


def identify(chain: Chain, kind: TorqueRows, data: Data) -> Fit:
    """Estimate base and essential parameters.

    Args:
        chain: the geometry to identify on; the base columns are chosen on the CAD geometry and regrouped on this one.
        kind: rows of torque: motors, joint torque sensors, or both.
        data: the recordings.
    """
    full = model(chain, kind)
    base = bases.regroup(nominal_base(kind), full)
    rows = collected(full, base, data)
    std = settled_std(rows)
    tested = eliminate(rows, Rule.F, level=LEVEL, std=std)
    # What the F-test keeps with a large RSD goes too.
    estimate = tested.essential.estimate
    poor = [name for name, rsd in zip(estimate.names, estimate.rsd) if rsd > MAX_RSD]
    good = [name for name in estimate.names if name not in poor]
    dropped = [step.name for step in tested.steps]
    supervised = eliminate(rows, Rule.F, level=LEVEL, keep=good, drop=[*dropped, *poor], std=std)
    by_ratio = eliminate(rows, Rule.RSD, ratio=RATIO, std=std)
    rules = {
        f"RSD ratio < {RATIO:g}": len(by_ratio.kept),
        "F": len(tested.kept),
        f"F, RSD < {MAX_RSD:g} %": len(supervised.kept),
    }
    return Fit(full, base, wls(rows, std), supervised, rules)


def computed_torque(fit: Fit, data: Data) -> dict[str, Any]:
    """Return errors of the torque below 2 Hz on other motion, rows of sensors and motors by joint [N m], [%]."""
    n = fit.model.bodies.n
    metrics: dict[str, Any] = {}
    for case in data.cases(fit.model.torque_rows):
        rows = observe(fit.model, fit.base.kept, case, case.motion.decimator)
        error = rows.target - rows.matrix @ fit.values
        # torques before the decimator's filter, at the samples of the rows
        torque = np.asarray(case.target)[:: case.motion.decimator.factor][: len(error)]
        for name, part in (("sensor", slice(0, n)), ("motor", slice(n, 2 * n))):
            relative = np.linalg.norm(error[:, part], axis=0) / np.linalg.norm(rows.target[:, part], axis=0)
            metrics[f"{case.name} {name}"] = {
                "rms": _rms(error[:, part]).tolist(),
                "largest": np.abs(error[:, part]).max(axis=0).tolist(),
                "relative_percent": (100.0 * relative).tolist(),
                "rms_of_torque": _rms(torque[:, part]).tolist(),
            }
    return metrics


def _rms(values: np.ndarray) -> np.ndarray:
    """Return the root mean square of each column."""
    return np.sqrt(np.mean(values**2, axis=0))


def tracking(chain: Chain, fits: dict[str, Fit], reference: Reference) -> dict[str, list[float]]:
    """Return rms tracking errors [mrad] of the true loaded arm without and with feed-forward by each estimate.

    Args:
        chain: geometry of the true arm.
        fits: name of an estimate to the estimate.
        reference: the motion to follow.
    """
    motor_model = model(chain, MOTOR)
    robot = Plant(motor_model.bodies, motor_model.terms, true_parameters(chain))
    feedback = replace(controller(robot, reference), ahead=None)
    errors = {"feedback alone": tracking_error(robot, feedback, reference)}
    for name, fit in fits.items():
        believed = Plant(fit.model.bodies, motor_model.terms, fit.base.to_standard(fit.values))
        errors[name] = tracking_error(robot, feedback, reference, feed_forward(believed, reference))
    return {name: (1e3 * error).tolist() for name, error in errors.items()}


def essential(fit: Fit) -> dict[str, Any]:
    """Return the essential parameters with RSDs [%], next to those of Table 4."""
    estimate = fit.elimination.essential.estimate
    names = set(estimate.names)
    paper = set(TABLE_4)
    return {
        "count": len(names),
        "table_4": len(TABLE_4),
        "both": sorted(names & paper),
        "only_here": sorted(names - paper),
        "only_table_4": sorted(paper - names),
        "rsd_percent": dict(zip(estimate.names, estimate.rsd.tolist())),
        "eliminated": [step.name for step in fit.elimination.steps],
    }


def errors_in_sigma(fit: Fit, truth: np.ndarray) -> float:
    """Return rms((x - truth) / σ) of all base parameters (b,)."""
    estimate = fit.fit.estimate
    errors = (estimate.values - truth) / estimate.sigma
    return float(np.sqrt(np.mean(errors**2)))


def side_by_side(cad: Fit, calibrated: Fit) -> dict[str, float]:
    """Return 100 |x_CAD - x_ID| / |x_ID| [%] of the base parameters essential on both geometries (Fig. 7)."""
    cad_estimate = cad.elimination.essential.estimate
    estimate = calibrated.elimination.essential.estimate
    calibrated_values = dict(zip(estimate.names, estimate.values))
    differences = {}
    for name, value in zip(cad_estimate.names, cad_estimate.values):
        if name in calibrated_values:
            reference = calibrated_values[name]
            differences[name] = float(100.0 * abs(value - reference) / abs(reference))
    return differences


def published(fit: Fit) -> dict[str, dict[str, float]]:
    """Return the simulated arm's estimates next to those published for another unit."""
    values = dict(zip(fit.base.names, fit.fit.estimate.values))
    values["ZZ2R + Ia2"] = values["ZZ2R"] + values["Ia2"]
    comparison = {}
    for name, reference in PUBLISHED.items():
        difference = 100.0 * abs(values[name] / reference - 1.0)
        comparison[name] = {"here": float(values[name]), "published": reference, "apart_percent": float(difference)}
    return comparison


def model_metrics(fit: Fit) -> dict[str, Any]:
    """Return the size of a model, its condition number and its true error."""
    return {
        "base": fit.base.b,
        "essential": fit.rules,
        "condition": fit.fit.condition_normalised,
        "error_in_sigma": errors_in_sigma(fit, _truth(fit)),
    }


def run(out: Path, seed: int = 0) -> dict[str, Any]:
    """Run the study; write and return the metrics."""
    truth = true_chain()
    calibrated = geometry.fitted_arm(seed)
    training = trajectory_b()
    validation = fourier([seed, 1001])
    data = record(truth, training, [seed, 0])
    unseen = record(truth, validation, [seed, 1])
    repetition = record(truth, training, [seed, 2])
    models = {}
    for number, kind in MODELS.items():
        models[f"Model {number}"] = model_metrics(identify(calibrated, kind, data))
    best = identify(calibrated, BOTH, data)
    fits = {"cad": identify(lwr4plus.nominal_chain(), BOTH, data), "calibrated": best}
    torque_errors = {name: computed_torque(fit, unseen) for name, fit in fits.items()}
    torque_errors["calibrated, B again"] = computed_torque(best, repetition)
    metrics: dict[str, Any] = {
        "counts": counts(),
        "models": models,
        "essential": essential(best),
        "computed_torque": torque_errors,
        "tracking_mrad": tracking(truth, fits, validation),
        "cad_against_calibrated_percent": side_by_side(fits["cad"], best),
        "published": published(best),
        "regrouping_left": float(best.base.lost.max(initial=0.0)),
        "parameters": {"standard": best.model.p, "base": best.base.b, "essential": len(best.elimination.kept)},
        "condition_number": {"raw": best.fit.condition, "normalised": best.fit.condition_normalised},
        "by_construction": ["motor inertias", "friction and its split", "offsets", "noise", "payload's shape"],
    }
    save(torques(best, unseen), out / "plot_torques.png")
    files.write_json(out / "metrics.json", metrics)
    return metrics


def _truth(fit: Fit) -> np.ndarray:
    """Return the true base parameters (b,) of a model."""
    chain = true_chain()
    by_name = dict(zip(model(chain, BOTH).names, true_parameters(chain)))
    standard = np.array([by_name[name] for name in fit.model.names])
    return fit.base.transform @ standard


def torques(fit: Fit, data: Data) -> Figure:
    """Draw the loaded sensors' torques below 2 Hz on other motion, measured and computed (Fig. 8)."""
    _, loaded = data.cases(BOTH)
    rows = observe(fit.model, fit.base.kept, loaded, loaded.motion.decimator)
    computed = rows.matrix @ fit.values
    t = np.linspace(loaded.motion.t[0], loaded.motion.t[-1], len(rows.target))
    with styled():
        figure, axes = sheet(4, 2, width=PAGE_WIDTH, height=6.4)
        for joint, axis in enumerate(axes[:7]):
            axis.plot(t, rows.target[:, joint], color=QUIET, linewidth=2.0, label="measured")
            axis.plot(t, computed[:, joint], color=AFTER, linewidth=0.8, linestyle="--", label="computed")
            axis.set_title(f"joint {joint + 1} [N m]", fontsize=7)
        error = rows.target[:, 5] - computed[:, 5]
        axes[7].plot(t, error, color=AFTER, linewidth=0.8)
        for line in (-PAPER_JOINT_6, PAPER_JOINT_6):
            axes[7].axhline(line, color=INK, linewidth=0.5)
        axes[7].set_title("joint 6, error [N m], and the paper's 0.5 N m", fontsize=7)
        axes[0].legend(fontsize=6, ncols=2, loc="upper right")
        for axis in axes[6:]:
            axis.set_xlabel("t [s]")
    return figure


def main() -> None:
    arguments = study_options.read(__doc__)
    metrics = run(arguments.out, arguments.seed)
    study_tables.show(study_tables.dynamics(metrics))


if __name__ == "__main__":
    main()
