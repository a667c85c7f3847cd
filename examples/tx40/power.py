"""The power model of a serial arm, and motions that keep its wrist from drowning: a Stäubli TX40.

    python examples/tx40/power.py

The power of all motors is one row per sample: what the wrist does is lost in the noise of the first three joints'
torques (Gautier & Briot 2013). Recordings in which these rest, with weights of their own, halve the σ of its drives;
its bodies, told mostly by what the arm does to them, gain a seventh. The truth obeys the model. Same total time, same
torque noise (3 % of each joint's rms torque, at least 0.02 N m), inverse dynamics beside.
"""

from __future__ import annotations

import numpy as np

from calib.dynamics.idim import from_chain
from calib.identification.identify import chain_states, identify_model
from calib.toolkit.chains import load
from calib.toolkit.model_identification import Identification
from calib.toolkit.recordings import FilterOptions, Recording, make_motion
from calib.toolkit.torque_models import (
    MOTOR,
    POWER,
    Case,
    IdentificationSettings,
    TorqueRows,
    make_case,
    standard_parameters,
)

RATE, SECONDS, PERIOD, NOISE = 500.0, 20.0, 10.0, 0.03
DRIVES = {"Ia": 0.05, "Fv": 2.0, "Fc": 3.0}  # of joint 1; a tenth of them at joint 6


def main(seed: int = 0) -> dict[str, dict[str, float]]:
    """Print and return the median σ [%] of well-known parameters (10 % by inverse dynamics), drives and bodies."""
    everything, again = recorded(seed, ()), recorded(seed + 1, ())
    wrist = [recorded(seed + 2 + k, (0, 1, 2), SECONDS / 2) for k in range(2)]
    found = {
        "power, all joints": identified(POWER, everything, again),
        "power, wrist apart": identified(POWER, everything, *wrist),
        "inverse dynamics": identified(MOTOR, everything, *wrist),
    }
    known = {name: spread(one) for name, one in found.items()}
    reference = known["inverse dynamics"]
    result = {}
    for name, own in known.items():
        parts = {
            f"{what} {which}": [
                own[key] for key, value in reference.items()
                if key[-1] in joints and value < 10.0 and (key[0] in "IF") == (what == "drives")
            ]
            for what in ("drives", "bodies") for which, joints in (("1-3", "123"), ("4-6", "456"))
        }  # fmt: skip
        result[name] = {part: float(np.median(values)) for part, values in parts.items()}
        print(f"{name:20} median sigma [%]:", ", ".join(f"{part} {x:.2f}" for part, x in result[name].items()))
    return result


def spread(found: Identification) -> dict[str, float]:
    """Return σ [%] by parameter."""
    estimate = found.fitted.estimate
    return dict(zip(estimate.names, estimate.rsd.tolist()))


def model(rows: TorqueRows):
    return from_chain(load("tx40"), "Ia Fv Fc", rows=rows, v0=0.05)


def recorded(seed: int, resting: tuple[int, ...], seconds: float = SECONDS) -> Recording:
    """Return a recording of a random Fourier motion, `resting` joints held."""
    chain, rng = load("tx40"), np.random.default_rng(seed)
    t = np.arange(int(seconds * RATE)) / RATE
    w = 2 * np.pi / PERIOD * np.arange(1, 11)
    s, c = np.sin(np.outer(t, w)), np.cos(np.outer(t, w))
    a, b = rng.normal(size=(2, 10, chain.n)) / np.arange(1, 11)[:, None] ** 0.7
    a[:, list(resting)] = b[:, list(resting)] = 0.0
    size = 0.35 * np.minimum(chain.upper, -chain.lower) / np.maximum(np.abs(s @ a + c @ b).max(axis=0), 1e-9)
    a, b = a * size, b * size
    rest = rng.uniform(-0.5, 0.5, chain.n) * np.isin(np.arange(chain.n), resting)
    q = s @ a + c @ b + rest
    v, acc = (c * w) @ a - (s * w) @ b, -(s * w**2) @ a - (c * w**2) @ b
    own = model(MOTOR)
    scale = np.linspace(1.0, 0.1, chain.n)
    values = np.concatenate([standard_parameters(chain), np.outer(scale, list(DRIVES.values())).ravel()])
    tau = own.torque(values, q, v, acc)
    noise = np.maximum(NOISE * np.sqrt(np.mean(tau**2, axis=0)), 0.02)
    return Recording(t, q, tau + noise * rng.normal(size=tau.shape), "torque", chain.joint_names, file=f"run{seed}")


def identified(rows: TorqueRows, *recordings: Recording) -> Identification:
    """Return the WLS estimate of a model's base parameters from recordings."""
    own = model(rows)
    cases: list[Case] = []
    for recording in recordings:
        motion = make_motion(recording, FilterOptions(cutoff=20.0, band=8.0))
        cases.append(make_case(recording.file, motion, rows))
    settings = IdentificationSettings(prior="none", essential="none", friction="standard", torque_rows=rows)
    return identify_model(own, cases, settings, states=chain_states(load("tx40"), own))


if __name__ == "__main__":
    main()
