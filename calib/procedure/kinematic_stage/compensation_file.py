"""What `calib compensate` writes and says."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calib import files
from calib.data.poses.target_files import Targets
from calib.errors import UsageError
from calib.procedure.kinematic_stage.compensation import Commands, Fitted

SHOWN = 20  # targets that a message lists
COLUMNS = (
    "left [mm]", "left [mrad]", "before [mm]", "before [mrad]", "sigma [mm]", "sigma [mrad]", "unseen_rms [mm]",
    "expected [mm]", "interval95 [mm]", "extrapolated",
)  # fmt: skip


def _header(names: Sequence[str]) -> list[str]:
    return ["row", *names, "status", *COLUMNS, "reason"]


def write(commands: Commands, fitted: Fitted, targets: Targets, out: Path, partial: bool = False) -> Path:
    """Write COMMANDS.csv, see `calib.data.poses.target_files`.

    Raises:
        UsageError: where targets are not reached and `partial` does not allow that; nothing is written.
    """
    lost = np.flatnonzero(~commands.reached)
    if len(lost) and (not partial or len(lost) == len(commands.q)):
        shown = [f"  target {k + 1}: {commands.reason[k]}" for k in lost[:SHOWN]]
        shown += [f"  and {len(lost) - SHOWN} more"] if len(lost) > SHOWN else []
        advice = "" if len(lost) == len(commands.q) else "\npartial (--partial) writes the others, these rows empty"
        head = f"{targets.file}: {len(lost)} of {len(commands.q)} targets are not reached; nothing was written"
        raise UsageError("\n".join([head, *shown]) + advice)
    names = targets.columns or fitted.cell.chain.joint_names
    factors = np.array(targets.factors or [1.0] * len(names))
    unseen = None if fitted.unseen is None else 1e3 * fitted.unseen
    rows = []
    for k, good in enumerate(commands.reached):
        q = (commands.q[k] / factors).tolist() if good else [None] * len(names)
        numbers = np.concatenate([commands.left[k], commands.before[k], commands.sigma[k]])
        cells = [None if np.isnan(value) else 1e3 * float(value) for value in numbers]
        there = (None, None) if commands.expected is None else (1e3 * commands.expected[k]).tolist()
        known = None if fitted.learnt is None else int(commands.beyond[k].any())
        status = "reached" if good else "not reached"
        rows.append((k + 1, *q, status, *cells, unseen, *there, known, commands.reason[k]))
    return files.write_table(out, _header(names), rows)


def lines(commands: Commands, targets: Targets, fitted: Fitted) -> list[str]:
    """Return what a person should know of the commands."""
    good = commands.reached
    result = [*commands.notes, *targets.notes]
    result += [f"ignored columns of {targets.file}: {', '.join(targets.ignored)}"] if targets.ignored else []
    result += [f"not reached: target {k + 1}: {commands.reason[k]}" for k in np.flatnonzero(~good)[:SHOWN]]
    result += [f"not reached: {int((~good).sum()) - SHOWN} more"] if (~good).sum() > SHOWN else []
    errors = (commands.before, commands.left, commands.sigma)
    before, left, sigma = (_pair(np.sqrt(np.mean(each[good] ** 2, axis=0))) for each in errors)
    apart = ""
    if commands.own is not None:
        own = _pair(np.sqrt(np.mean(commands.own[good] ** 2, axis=0)))
        apart = f" ({own} are the arm's own, the rest is where its base stands: --frame nominal leaves that out)"
    result += [
        f"by the calibrated model, rms over {int(good.sum())} targets: {before} without compensation{apart}, "
        f"{left} with it; sigma of the model {sigma}"
    ]
    result += [_expectation(commands, fitted), *_extrapolation(commands, fitted)]
    most = np.abs(commands.q - commands.nominal)[good].max(initial=0.0)
    return [*result, f"joints move by {1e3 * most:.3g} mrad (mm) at most"]


def _expectation(commands: Commands, fitted: Fitted) -> str:
    """Say what to expect of the real arm at these targets, by the error model where there is one."""
    good = commands.reached
    apart = "" if fitted.unseen is None else f"; {1e3 * fitted.unseen:.3g} mm rms were found on poses not fitted"
    if commands.expected is not None:
        rms = np.sqrt(np.mean(commands.expected[good, 0] ** 2))
        within = commands.expected[good, 1].max()
        return (
            f"what to expect of the real arm at these targets: {1e3 * rms:.3g} mm rms, at the worst one 95 % within "
            f"{1e3 * within:.3g} mm{apart}"
        )
    if fitted.unseen is not None and not commands.beyond[good].any():
        return f"what to expect of the real arm: {1e3 * fitted.unseen:.3g} mm rms, as on poses not fitted"
    known = "" if fitted.fitted is None else f" ({1e3 * fitted.fitted:.3g} mm rms on the fitted ones)"
    why = f"the fit had no unseen poses{known}" if fitted.unseen is None else "targets outside the range measured"
    return f"{why}: nothing says what to expect of the real arm{apart}"


def _extrapolation(commands: Commands, fitted: Fitted) -> list[str]:
    """Say how many targets extrapolate, and which joints."""
    out = commands.beyond & commands.reached[:, None]
    if not out.any():
        return []
    names = ", ".join(fitted.cell.chain.joint_names[j] for j in np.unique(np.nonzero(out)[1]).tolist())
    return [
        f"EXTRAPOLATED: {int(out.any(axis=1).sum())} of {int(commands.reached.sum())} targets have joints outside the "
        f"range that was measured ({names}): no measurement proves the arm there; measure poses like them"
    ]


def _pair(values: np.ndarray) -> str:
    turn = "" if np.isnan(values[1]) else f" and {1e3 * values[1]:.3g} mrad"
    return f"{1e3 * values[0]:.3g} mm{turn}"
