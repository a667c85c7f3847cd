"""The dynamic half of the LWR4+ study, scripted: Models 1 to 3, two loads, CAD geometry and that of geometry.py's fit.

Kolyubin, Shiriaev & Jubien (2019), Int. J. Adv. Manuf. Technol. 101, 243-259, sections 4 and 6.2, on a simulated arm:
the calibrated column of their Table 2, a 3.28 kg payload, joint torque sensors, 1 kHz, 10 Hz Butterworth, decimation to
2 Hz. *Calibrated* is the geometry fitted to 17 measured poses. Motion: the best by condition number of 40 random
Fourier series of five harmonics and 25 s, not their designed Trajectory B.

By construction, so no evidence about a real arm: motor inertias and total friction are the published ones of another
unit (Jubien, Gautier & Janot 2014); their split between the sides, offsets and noise are chosen with Table 4 in view;
the truth obeys the model. The counts, and which inertial parameters turn out essential, do not depend on that. How many
are essential depends on the noise and the rule: the paper supervised its rule by hand; here an F-test, then whatever
has an RSD above 10 % goes, and the paper's own ratio of RSDs is shown beside it.

    python examples/lwr4plus/dynamics.py --out lwr4plus-dynamics [--quick] [--seed 0]
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import geometry
import numpy as np
import study_options
import study_tables
from matplotlib.figure import Figure

from calib import files
from calib.data.recordings.recording import Recording
from calib.data.signals.motion import FilterOptions, make_motion
from calib.dynamics import base as bases
from calib.dynamics import drives
from calib.dynamics.base import Base
from calib.dynamics.bodies import bodies_of, standard_parameters, with_payload
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.torque_rows import BOTH, LINK, MODELS, MOTOR, TorqueRows
from calib.estimation.essential import Elimination, Rule, eliminate
from calib.estimation.linear import LinearFit, settled_std, wls
from calib.estimation.triangles import Triangles, absorb, empty
from calib.identification.loop import Controller
from calib.identification.rows import Case, make_case, observe
from calib.procedure.report.style import AFTER, INK, PAGE_WIDTH, QUIET, save, sheet, styled
from calib.robot.chain import Chain
from calib.rooms.cells import known_robots, lwr4plus
from calib.rooms.cells.known_robots import random_fourier
from calib.rooms.closed_loop.controllers import Reference, pd
from calib.rooms.closed_loop.simulation import Plant, Sensing, feed_forward, simulate, tracking_error
from calib.transforms import pose

PAYLOAD = "8"
RATE = 1000.0
REACH = 0.8 * np.deg2rad([170.0, 120.0, 170.0, 120.0, 170.0, 90.0, 170.0])
SPEED = 0.8 * np.deg2rad([110.0, 110.0, 128.0, 128.0, 204.0, 184.0, 184.0])
TORQUE = np.array([176.0, 176.0, 100.0, 100.0, 100.0, 38.0, 38.0])
PAPER_JOINT_6 = 0.5  # [N m], within which Fig. 8's joint 6 stays "along most of the validation trajectory"
RATIO, POOR = 30.0, 10.0  # r_σ of the paper's rule; RSD [%] above which a parameter goes
FILTERS = FilterOptions(cutoff=10.0, band=2.0, clock="stamps")
TABLE_4 = (
    "Ia1", "Fvm1", "Fcm1", "Ia2", "Fvm2", "Fcm2", "Ia3", "Fvm3", "Fcm3", "Fvm4", "Ia5", "Fvm5", "Fcm5", "Ia6", "Fvm6",
    "Fcm6", "Ia7", "Fvm7", "Fcm7", "offm7", "Fcl1", "Fcl2", "offl2", "Fcl3", "Fcl4", "offl4", "Fcl5", "offl5", "Fcl7",
    "offl7", "XX2R", "ZZ2R", "MY2R", "XX4R", "ZZ4R", "MY4R", "MY5R", "MY6R", "XX8", "YY8", "YZ8", "MY8", "MZ8", "M8",
)  # fmt: skip
# Jubien, Gautier & Janot (2014), another unit, by way of kukaKDL's kukakdl_const.hpp; ZZ2R there holds Ia2. Its motor
# inertias and friction are the truth here (by construction), so only the links' parameters are compared.
PUBLISHED = {"XX2R": 1.31, "ZZ2R + Ia2": 4.46, "MY2R": 3.37, "XX4R": 0.368, "MY4R": -1.37, "MY5R": 0.049, "MY6R": 0.042}


@dataclass(frozen=True)
class Data:
    """One motion, recorded without and with the payload."""

    empty: Recording
    loaded: Recording

    def cases(self, kind: TorqueRows) -> list[Case]:
        motions = [make_motion(part, FILTERS) for part in (self.empty, self.loaded)]
        return [
            make_case("empty", motions[0], kind, carried=()),
            make_case("loaded", motions[1], kind, carried=(PAYLOAD,)),
        ]


def model(
    chain: Chain, kind: TorqueRows, gravity: np.ndarray | None = None, v0: float = drives.V0
) -> IdentificationModel:
    """Return the study's model: seven links and a payload, seven drive terms each; the payload's move nothing.

    The sign of Coulomb friction is smoothed over v0 [rad/s].
    """
    bodies = with_payload(
        bodies_of(chain), pose(position=np.array([0.0, 0.0, known_robots.truth("lwr4plus")["payload"]["r"]]))
    )
    bodies = bodies if gravity is None else bodies.with_gravity(gravity)
    terms = drives.standard([" ".join(known_robots.SIDED)] * chain.n, v0)
    return IdentificationModel(bodies, (*terms, *drives.without_effect(PAYLOAD)), kind)


def true_chain() -> Chain:
    """Return the simulated arm: the calibrated column of Table 2 with the library's inertias."""
    return lwr4plus.arm(lwr4plus.table_2()[1])


def true_parameters(chain: Chain) -> np.ndarray:
    """Return the standard parameters (136,) of the simulated arm, in the order of `model` of both rows."""
    known = known_robots.truth("lwr4plus")
    sided = [known["drives"][name][joint] for joint in range(chain.n) for name in known_robots.SIDED]
    return np.concatenate([standard_parameters(chain), known["payload"]["inertia"], sided, np.zeros(7)])


@cache
def nominal_base(kind: TorqueRows) -> Base:
    """Return the base columns of a model, chosen on the CAD geometry."""
    return bases.find(model(lwr4plus.nominal_chain(), kind))


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


def choose_motion(chain: Chain, quick: bool, seed: int) -> Reference:
    """Return the best of a few random motions by the condition number of Model 2's base columns at unit norm."""
    both = model(chain, BOTH)
    kept = nominal_base(BOTH).kept

    def condition(reference: Reference) -> float:
        part = slice(None, None, 250)
        states = (reference.q[part], reference.v[part], reference.a[part])
        rows = [both.regressor(*states, carried=load)[:, :, kept].reshape(-1, len(kept)) for load in ((), (PAYLOAD,))]
        stacked = np.vstack(rows)
        return float(np.linalg.cond(stacked / np.linalg.norm(stacked, axis=0)))

    return min((fourier([seed, number]) for number in range(5 if quick else 40)), key=condition)


def fourier(seed: list[int]) -> Reference:
    return random_fourier(-REACH, REACH, SPEED, 25.0, RATE, 5, seed=np.random.default_rng(seed))


def record(chain: Chain, reference: Reference, seed: list[int]) -> Data:
    """Let the true arm follow a motion, empty and loaded, and log positions, motor torques and joint torques."""
    parts = [_record(chain, reference, loaded, [*seed, int(loaded)]) for loaded in (False, True)]
    return Data(*parts)


def _record(chain: Chain, reference: Reference, loaded: bool, seed: list[int]) -> Recording:
    noise, values = known_robots.truth("lwr4plus")["noise"], true_parameters(chain)
    whole = model(chain, MOTOR)
    if not loaded:
        values[10 * chain.n : 10 * (chain.n + 1)] = 0.0
    plant = Plant(whole.bodies, whole.terms, values)
    run = simulate(plant, controller(plant, reference), reference, Sensing(noise["sigma_q"]), seed)
    link = model(chain, LINK)
    shared = np.array([name in link.names for name in whole.names])
    tau_l = np.einsum("kij,j->ki", link.regressor(run.q, run.v, run.a), values[shared])
    rng = np.random.default_rng([*seed, 2])
    sensed = tau_l + noise["sigma_tau_l"] * TORQUE * rng.normal(size=tau_l.shape)
    motor = run.torque + noise["sigma_tau_m"] * TORQUE * rng.normal(size=tau_l.shape)
    return Recording(
        run.t, run.measured, motor, "torque", tuple(f"joint_{j + 1}" for j in range(chain.n)), tau_link=sensed
    )


def controller(plant: Plant, reference: Reference) -> Controller:
    """Return a PD controller (8 Hz, damping 0.8, our choice) with feed-forward of gravity and friction."""
    omega, inertia = 2 * np.pi * 8.0, plant.inertia_diagonal(reference.q[::500])
    slow = replace(reference, a=0.0 * reference.a)
    return pd(omega**2 * inertia, 2 * 0.8 * omega * inertia).with_feedforward(feed_forward(plant, slow))


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


def collected(own: IdentificationModel, base: Base, data: Data) -> Triangles:
    """Return the filtered and decimated rows of both loads, in one triangle per torque."""
    result = empty(base.names, base.units, own.rows)
    for case in data.cases(own.torque_rows):
        rows = observe(own, base.kept, case, case.motion.decimator)
        for row in range(own.rows):
            result = absorb(result, rows.matrix[:, row], rows.target[:, row], row)
    return result


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


def run(out: Path, quick: bool = False, seed: int = 0) -> dict[str, Any]:
    """Run the study; write and return the metrics."""
    nominal, truth = lwr4plus.nominal_chain(), true_chain()
    calibrated = geometry.fitted_arm(seed)
    training, other = choose_motion(nominal, quick, seed), fourier([seed, 1001])
    data, unseen = record(truth, training, [seed, 0]), record(truth, other, [seed, 1])
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
        "computed_torque": {name: computed_torque(found, unseen) for name, found in fits.items()},
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
    options = study_options.read(__doc__, quick="fewer candidate motions")
    study_tables.show(study_tables.dynamics(run(options.out, options.quick, options.seed)))


if __name__ == "__main__":
    main()
