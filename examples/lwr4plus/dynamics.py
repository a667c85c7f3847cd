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
from excitation import RATE
from matplotlib.figure import Figure
from simulated_arm import TABLE_4, Data, collected, controller, model, nominal_base, record, true_chain, true_parameters

from calib import files
from calib.dynamics import base as bases
from calib.dynamics.torque_rows import MODELS
from calib.estimation.essential import Elimination, Rule, eliminate
from calib.procedure.excitation import coefficients
from calib.procedure.report.figures.sheets import save, sheet, styled
from calib.simulation import lwr4plus
from calib.toolkit.chains import Chain
from calib.toolkit.report_charts import AFTER, INK, PAGE_WIDTH, QUIET
from calib.toolkit.simulations import Plant, Reference, feed_forward, random_fourier, tracking_error
from calib.toolkit.statistics import LinearFit, settled_std, wls
from calib.toolkit.torque_models import BOTH, MOTOR, Base, IdentificationModel, TorqueRows, observe

REACH = 0.8 * np.deg2rad([170.0, 120.0, 170.0, 120.0, 170.0, 90.0, 170.0])
SPEED = 0.8 * np.deg2rad([110.0, 110.0, 128.0, 128.0, 204.0, 184.0, 184.0])
PAPER_JOINT_6 = 0.5  # [N m], within which Fig. 8's joint 6 stays "along most of the validation trajectory"
RATIO, POOR = 30.0, 10.0  # r_σ of the paper's rule; RSD [%] above which a parameter goes
# Jubien, Gautier & Janot (2014), another unit, by way of kukaKDL's kukakdl_const.hpp; ZZ2R there holds Ia2. Its motor
# inertias and friction are the truth here (by construction), so only the links' parameters are compared.
PUBLISHED = {"XX2R": 1.31, "ZZ2R + Ia2": 4.46, "MY2R": 3.37, "XX4R": 0.368, "MY4R": -1.37, "MY5R": 0.049, "MY6R": 0.042}


def counts() -> dict[str, int]:
    """Return the numbers of base parameters of the models and their variants, on the CAD geometry."""
    chain = lwr4plus.nominal_chain()
    both = model(chain, BOTH)
    tilted = model(chain, BOTH, 9.81 * np.array([0.3, 0.2, -np.sqrt(1 - 0.13)]))
    whole = nominal_base(BOTH)
    found = {f"Model {number}": nominal_base(kind).b for number, kind in MODELS.items()}
    found |= {
        "one load case": bases.find(both, loads=[None]).b,
        "motor torque only": nominal_base(MOTOR).b,
        "tilted": bases.find(tilted).b,
        "standard": both.p,
        "without effect": len(whole.without_effect),
        "regrouped": len(whole.regrouped),
    }
    return found


def trajectory_b() -> Reference:
    """Return one period of Trajectory B, 44 columns, as kept of `excitation.py`'s first seed."""
    found = coefficients.read(Path(__file__).parent)
    t = np.arange(round(found.period * RATE)) / RATE
    return Reference(t, *found.orders(t))


def fourier(seed: list[int]) -> Reference:
    """Return a random motion that no model is fitted to."""
    return random_fourier(-REACH, REACH, SPEED, 25.0, RATE, 5, seed=np.random.default_rng(seed))


@dataclass(frozen=True)
class Fit:
    """One model, identified on one geometry."""

    model: IdentificationModel
    base: Base
    fit: LinearFit
    elimination: Elimination
    rules: dict[str, int]


def identify(chain: Chain, kind: TorqueRows, data: Data) -> Fit:
    """Estimate base and essential parameters: columns chosen on the CAD geometry, regrouped on the one given."""
    own = model(chain, kind)
    base = bases.regroup(nominal_base(kind), own)
    rows = collected(own, base, data)
    std = settled_std(rows)
    tested = eliminate(rows, Rule.F, level=0.01, std=std)
    first = tested.essential.estimate
    poor = [name for name, rsd in zip(first.names, first.rsd) if rsd > POOR]
    good = [name for name in first.names if name not in poor]
    gone = [step.name for step in tested.steps]
    supervised = eliminate(rows, Rule.F, level=0.01, keep=good, drop=[*gone, *poor], std=std)
    rules = {
        f"RSD ratio < {RATIO:g}": len(eliminate(rows, Rule.RSD, ratio=RATIO, std=std).kept),
        "F": len(tested.kept),
        f"F, RSD < {POOR:g} %": len(supervised.kept),
    }
    return Fit(own, base, wls(rows, std), supervised, rules)


def values_of(found: Fit) -> np.ndarray:
    """Return all base parameters: the essential estimate, and zero for the others."""
    values = np.zeros(found.base.b)
    values[found.elimination.kept] = found.elimination.essential.estimate.values
    return values


def computed_torque(found: Fit, data: Data) -> dict[str, Any]:
    """Return errors of the torque below 2 Hz on other motion, rows of sensors and motors by joint [N m], [%]."""
    result: dict[str, Any] = {}
    for case in data.cases(found.model.torque_rows):
        rows = observe(found.model, found.base.kept, case, case.motion.decimator)
        error = rows.target - rows.matrix @ values_of(found)
        n = found.model.bodies.n
        raw = np.asarray(case.target)
        above = raw[:: case.motion.decimator.factor][: len(error)]
        for name, part in (("sensor", slice(0, n)), ("motor", slice(n, 2 * n))):
            result[f"{case.name} {name}"] = {
                "rms": np.sqrt(np.mean(error[:, part] ** 2, axis=0)).tolist(),
                "largest": np.abs(error[:, part]).max(axis=0).tolist(),
                "relative_percent": (
                    100.0 * np.linalg.norm(error[:, part], axis=0) / np.linalg.norm(rows.target[:, part], axis=0)
                ).tolist(),
                "rms_of_torque": np.sqrt(np.mean(above[:, part] ** 2, axis=0)).tolist(),
            }
    return result


def tracking(chain: Chain, fits: dict[str, Fit], reference: Reference) -> dict[str, list[float]]:
    """Return rms tracking errors [mrad] of the true loaded arm without and with feed-forward by each estimate."""
    whole = model(chain, MOTOR)
    robot = Plant(whole.bodies, whole.terms, true_parameters(chain))
    bare = replace(controller(robot, reference), ahead=None)
    result = {"feedback alone": tracking_error(robot, bare, reference)}
    for name, found in fits.items():
        believed = Plant(found.model.bodies, whole.terms, found.base.to_standard(values_of(found)))
        result[name] = tracking_error(robot, bare, reference, feed_forward(believed, reference))
    return {name: (1e3 * error).tolist() for name, error in result.items()}


def essential(found: Fit) -> dict[str, Any]:
    """Return the essential parameters with RSDs [%], next to those of Table 4."""
    estimate = found.elimination.essential.estimate
    names = set(estimate.names)
    return {
        "count": len(names), "table_4": len(TABLE_4),
        "both": sorted(names & set(TABLE_4)), "only_here": sorted(names - set(TABLE_4)),
        "only_table_4": sorted(set(TABLE_4) - names),
        "rsd_percent": {name: float(x) for name, x in zip(estimate.names, estimate.rsd)},
        "eliminated": [step.name for step in found.elimination.steps],
    }  # fmt: skip


def errors_in_sigma(found: Fit, truth: np.ndarray) -> float:
    """Return rms((x - truth) / σ) of all base parameters."""
    estimate = found.fit.estimate
    return float(np.sqrt(np.mean(((estimate.values - truth) / estimate.sigma) ** 2)))


def side_by_side(cad: Fit, calibrated: Fit) -> dict[str, float]:
    """Return 100 |x_CAD - x_ID| / |x_ID| [%] of the base parameters essential on both geometries (Fig. 7)."""
    own = {name: k for k, name in enumerate(calibrated.elimination.essential.estimate.names)}
    first = cad.elimination.essential.estimate
    second = calibrated.elimination.essential.estimate.values
    return {
        name: float(100.0 * abs(x - second[own[name]]) / abs(second[own[name]]))
        for name, x in zip(first.names, first.values)
        if name in own
    }


def published(found: Fit) -> dict[str, dict[str, float]]:
    """Return the simulated arm's estimates next to those published for another unit."""
    values = dict(zip(found.base.names, found.fit.estimate.values))
    values["ZZ2R + Ia2"] = values["ZZ2R"] + values["Ia2"]
    return {
        name: {"here": float(values[name]), "published": x, "apart_percent": float(100.0 * abs(values[name] / x - 1.0))}
        for name, x in PUBLISHED.items()
    }


def run(out: Path, seed: int = 0) -> dict[str, Any]:
    """Run the study; write and return the metrics."""
    nominal, truth = lwr4plus.nominal_chain(), true_chain()
    calibrated = geometry.fitted_arm(seed)
    training, other = trajectory_b(), fourier([seed, 1001])
    data, unseen = record(truth, training, [seed, 0]), record(truth, other, [seed, 1])
    again = record(truth, training, [seed, 2])
    metrics: dict[str, Any] = {"counts": counts(), "models": {}}
    for number, kind in MODELS.items():
        found = identify(calibrated, kind, data)
        metrics["models"][f"Model {number}"] = {
            "base": found.base.b, "essential": found.rules,
            "condition": found.fit.condition_normalised, "error_in_sigma": errors_in_sigma(found, _truth(found)),
        }  # fmt: skip
    fits = {name: identify(chain, BOTH, data)
            for name, chain in (("cad", nominal), ("calibrated", calibrated))}  # fmt: skip
    best = fits["calibrated"]
    metrics |= {
        "essential": essential(best),
        "computed_torque": {name: computed_torque(found, unseen) for name, found in fits.items()}
        | {"calibrated, B again": computed_torque(best, again)},
        "tracking_mrad": tracking(truth, fits, other),
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


def _truth(found: Fit) -> np.ndarray:
    """Return the true base parameters of a model."""
    chain = true_chain()
    known = dict(zip(model(chain, BOTH).names, true_parameters(chain)))
    return found.base.transform @ np.array([known[name] for name in found.model.names])


def torques(found: Fit, data: Data) -> Figure:
    """Draw the loaded sensors' torques below 2 Hz on other motion, measured and computed (Fig. 8)."""
    case = data.cases(BOTH)[1]
    rows = observe(found.model, found.base.kept, case, case.motion.decimator)
    computed, t = rows.matrix @ values_of(found), np.linspace(case.motion.t[0], case.motion.t[-1], len(rows.target))
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
    options = study_options.read(__doc__)
    study_tables.show(study_tables.dynamics(run(options.out, options.seed)))


if __name__ == "__main__":
    main()
