"""The power model of a serial arm, and motions that keep its wrist from drowning: a Stäubli TX40.

    python examples/tx40/power.py

The power of all motors is one row per sample: what the wrist does is lost in the noise of the first three joints'
torques (Gautier & Briot 2013). Recordings in which these rest, with weights of their own, halve the σ of its drives;
its bodies, told mostly by what the arm does to them, gain a seventh. The truth obeys the model. Same total time, same
torque noise (3 % of each joint's rms torque, at least 0.02 N m), inverse dynamics beside.
"""

from __future__ import annotations

import numpy as np

import calib
from calib.dynamics.idim import from_chain
from calib.identification.identify import chain_states, identify_model
from calib.toolkit.chains import Chain
from calib.toolkit.model_identification import Identification
from calib.toolkit.recordings import FilterOptions, Recording, make_motion
from calib.toolkit.simulations import Reference
from calib.toolkit.torque_models import (
    MOTOR,
    POWER,
    IdentificationModel,
    IdentificationSettings,
    TorqueRows,
    make_case,
    standard_parameters,
)

# of a recording: rate [Hz], duration [s]; period of its motion [s], harmonics
RATE, SECONDS = 500.0, 20.0
PERIOD, HARMONICS = 10.0, 10
# torque noise, as share of each joint's rms torque, and its least value [N m]
NOISE, MIN_NOISE = 0.03, 0.02
# share of a joint's range that its motion fills
REACH = 0.35
# drive parameters of joint 1 in SI units; a tenth of them at joint 6
DRIVES = {"Ia": 0.05, "Fv": 2.0, "Fc": 3.0}
# joints that rest in recordings of the wrist
ARM = (0, 1, 2)
# parameters with a σ below this [%], by inverse dynamics, are compared
WELL_KNOWN = 10.0
FILTERS = FilterOptions(cutoff=20.0, band=8.0)


def main(seed: int = 0) -> dict[str, dict[str, float]]:
    """Print and return the median σ [%] of well-known parameters (10 % by inverse dynamics), drives and bodies."""
    all_joints = record(seed)
    repetition = record(seed + 1)
    wrist = [record(seed + 2, ARM, SECONDS / 2), record(seed + 3, ARM, SECONDS / 2)]
    identifications = {
        "power, all joints": identify(POWER, all_joints, repetition),
        "power, wrist apart": identify(POWER, all_joints, *wrist),
        "inverse dynamics": identify(MOTOR, all_joints, *wrist),
    }
    sigmas = {name: relative_sigmas(identification) for name, identification in identifications.items()}
    well_known = [name for name, sigma in sigmas["inverse dynamics"].items() if sigma < WELL_KNOWN]
    medians = {}
    for name, by_parameter in sigmas.items():
        medians[name] = median_sigmas({parameter: by_parameter[parameter] for parameter in well_known})
        text = ", ".join(f"{part} {sigma:.2f}" for part, sigma in medians[name].items())
        print(f"{name:20} median sigma [%]: {text}")
    return medians


def relative_sigmas(identification: Identification) -> dict[str, float]:
    """Return σ [%] by parameter."""
    estimate = identification.fitted.estimate
    return dict(zip(estimate.names, estimate.rsd.tolist()))


def median_sigmas(sigmas: dict[str, float]) -> dict[str, float]:
    """Return the median σ [%] of drives and bodies, of arm and wrist.

    Args:
        sigmas: name of a parameter to its σ [%].
    """
    parts: dict[str, list[float]] = {"drives 1-3": [], "drives 4-6": [], "bodies 1-3": [], "bodies 4-6": []}
    for name, sigma in sigmas.items():
        kind = "drives" if name.startswith(("Ia", "Fv", "Fc")) else "bodies"
        # names of regrouped parameters end with R; they are not compared
        if name[-1] in "123":
            parts[f"{kind} 1-3"].append(sigma)
        elif name[-1] in "456":
            parts[f"{kind} 4-6"].append(sigma)
    return {part: float(np.median(values)) for part, values in parts.items()}


def make_model(rows: TorqueRows) -> IdentificationModel:
    return from_chain(calib.load("tx40").chain, "Ia Fv Fc", rows=rows, v0=0.05)


def fourier_motion(chain: Chain, resting: tuple[int, ...], seconds: float, rng: np.random.Generator) -> Reference:
    """Return a random Fourier motion about the middle of the joints' ranges.

    Args:
        chain: the arm with its limits.
        resting: joints that rest at a random position.
        seconds: duration [s].
        rng: source of the coefficients.
    """
    t = np.arange(int(seconds * RATE)) / RATE
    harmonics = np.arange(1, HARMONICS + 1)
    omega = 2 * np.pi / PERIOD * harmonics
    sine, cosine = np.sin(np.outer(t, omega)), np.cos(np.outer(t, omega))
    # coefficients (harmonics, n)
    a, b = rng.normal(size=(2, HARMONICS, chain.n)) / harmonics[:, None] ** 0.7
    a[:, list(resting)] = 0.0
    b[:, list(resting)] = 0.0
    amplitude = np.abs(sine @ a + cosine @ b).max(axis=0)
    scale = REACH * np.minimum(chain.upper, -chain.lower) / np.maximum(amplitude, 1e-9)
    a, b = scale * a, scale * b
    position = rng.uniform(-0.5, 0.5, chain.n) * np.isin(np.arange(chain.n), resting)
    q = sine @ a + cosine @ b + position
    v = (cosine * omega) @ a - (sine * omega) @ b
    acceleration = -(sine * omega**2) @ a - (cosine * omega**2) @ b
    return Reference(t, q, v, acceleration)


def true_parameters(chain: Chain) -> np.ndarray:
    """Return the standard parameters (p,): the library's bodies, drives that become smaller towards the wrist."""
    share = np.linspace(1.0, 0.1, chain.n)
    drives = np.outer(share, list(DRIVES.values()))
    return np.concatenate([standard_parameters(chain), drives.ravel()])


def record(seed: int, resting: tuple[int, ...] = (), seconds: float = SECONDS) -> Recording:
    """Return a recording of a random Fourier motion.

    Args:
        seed: seed of motion and noise.
        resting: joints that rest.
        seconds: duration [s].
    """
    chain = calib.load("tx40").chain
    rng = np.random.default_rng(seed)
    motion = fourier_motion(chain, resting, seconds, rng)
    torque = make_model(MOTOR).torque(true_parameters(chain), motion.q, motion.v, motion.a)
    noise = np.maximum(NOISE * np.sqrt(np.mean(torque**2, axis=0)), MIN_NOISE)
    measured = torque + noise * rng.normal(size=torque.shape)
    return Recording(motion.t, motion.q, measured, "torque", chain.joint_names, file=f"run{seed}")


def identify(rows: TorqueRows, *recordings: Recording) -> Identification:
    """Return the WLS estimate of a model's base parameters from recordings."""
    model = make_model(rows)
    cases = [make_case(recording.file, make_motion(recording, FILTERS), rows) for recording in recordings]
    settings = IdentificationSettings(prior="none", essential="none", friction="standard", torque_rows=rows)
    states = chain_states(calib.load("tx40").chain, model)
    return identify_model(model, cases, settings, states=states)


if __name__ == "__main__":
    main()
