"""The simulated loop in the report section on the dynamics: bias of least squares, tracking with feedforward."""

from collections.abc import Mapping

import numpy as np

from calib.identification.loop import (
    CAD,
    DAMPING,
    FEEDBACK,
    FLOOR,
    FREQUENCY,
    IDENTIFIED,
    MAX_SHIFT_SIGMAS,
    LoopMetrics,
    Replay,
)
from calib.procedure.report import page

FED_FORWARD = {
    FEEDBACK: "feedback alone",
    CAD: "CAD fed forward",
    IDENTIFIED: "model fed forward",
    FLOOR: "measured torque fed forward",
}


def loop_sentences(loop: LoopMetrics) -> list[str]:
    """Return sentences on the closed-loop simulation, and on the bias of least squares that it reveals."""
    lines = list(loop.notes)
    test = loop.durbin_wu_hausman
    if test is None:
        return lines

    subject = ""
    if loop.beside:
        subject = f"results of the test of least squares by {loop.instruments}, not of this estimate: "
    lines.append(
        f"{subject}closed loop simulated, {loop.rounds} rounds; difference of simulated and recorded motion "
        f"{_joints(loop.distance_percent)} %, torque {_joints(loop.simulated_torque_error_percent)} %"
    )
    strength = "weak" if loop.instruments_weak else "strong"
    lines.append(
        f"instruments: full rank, Cragg-Donald {page.number(loop.cragg_donald)} ({strength}), smallest explained share "
        f"of a column {100 * loop.least_partial_r2:.3g} %"
    )

    if not loop.explains:
        result = "no result, since the simulated loop explains less of the torque than the model"
    elif not test.least_squares_biased:
        result = "no bias of least squares is detected"
    elif loop.largest_shift_sigma < MAX_SHIFT_SIGMAS:
        result = "least squares is biased, significantly but slightly"
    else:
        result = "least squares is biased"
    if not loop.valid:
        result += ", but the instruments are unreliable"
    p = f"p = {test.p:.2g}" if test.p > 0.0 else "p < 1e-300"
    degrees = ", ".join(f"{degree:g}" for degree in test.degrees)
    lines.append(
        f"Durbin-Wu-Hausman: F({degrees}) = {page.number(test.statistic)}, {p}: {result}; largest shift "
        f"{loop.largest_shift_sigma:.3g} sigma"
    )
    return lines


def _joints(shares: np.ndarray) -> str:
    return " ".join(map(page.number, shares))


def tracking_blocks(replays: Mapping[str, Replay], failure: str = "") -> list[page.Block]:
    """Return tables and texts on simulated tracking errors with the model as feedforward.

    Args:
        replays: name of a recording -> simulated tracking.
        failure: reason why no tracking was simulated; empty: none.
    """
    if failure:
        line = f"tracking with the model as feedforward was not simulated: {failure}"
        return [page.Text("Tracking, simulated", [line])]
    if not replays:
        return []

    groups = {}
    for name, replay in replays.items():
        rows = []
        for key, rms in replay.rms.items():
            errors = map(page.number, 1e3 * rms)
            rows.append((FED_FORWARD[key], *errors))
        groups[name] = rows

    first = next(iter(replays.values()))
    lines = []
    gain = f": feedforward of the model reduces the tracking error by a factor of {first.feedback_over_model:.3g}"
    if first.inertia_added.any():
        inertia = " ".join(f"{added:.2g}" for added in first.inertia_added)
        lines.append(
            f"the identified model is physically inconsistent: simulation adds motor inertia, {inertia} kg m² (kg); "
            "compare only the rows with each other"
        )
        gain = ""
    control = f"a PD of {FREQUENCY:g} Hz, damping {DAMPING:g} (our default)"
    if first.stated:
        control = "the controller of [loop]"
    motion = "unseen motion" if first.unseen else "the training motion, which gives too small errors"
    lines.append(f"the simulated robot is the identified model plus the unexplained torque; {control}; {motion}{gain}")

    title = "Tracking, simulated: rms of q - reference [mrad or mm]"
    joints = [str(j + 1) for j in range(len(first.inertia_added))]
    return [page.grouped(title, ("fed forward", *joints), groups), page.Text("", lines)]
