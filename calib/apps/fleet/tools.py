"""Tools of a fleet: is one that several arms share bent or loose, by what those arms show against all others?"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from calib.errors import Finding, finding

MIN_ARMS = 2, 3  # with the tool, and with others, that a comparison needs (our choice)
SIGMAS = 2.6  # between medians, above it a tool is named: 99 %, as of other findings
FAR = 3.0  # times the typical distance from the median, which larger ones count as (our choice)
WORTH = 0.8  # share of the degrees of freedom that is left by that (our choice)
MIN_SCATTER = 1e-6  # [m, or of a logarithm]
MIN_TIMES = 1.5  # of the others' error, below it a tool is not called loose (our choice)


@dataclass(frozen=True)
class ToolUse:
    """What arms with one tool show, against arms of the same type with others.

    Attributes:
        tool: its name in the measurements (``tool`` of the options file).
        arms: their names.
        moved: distance of its median position from that of the others [m].
        moved_sigmas: deviation of a normal variable that is as unlikely, as arms with one tool differ among themselves.
        times: median rms error, divided by that of the others.
        times_sigmas: of its logarithm, the same; all four are None where too few arms are compared.
    """

    tool: str
    arms: tuple[str, ...]
    moved: float | None = None
    moved_sigmas: float | None = None
    times: float | None = None
    times_sigmas: float | None = None

    def findings(self) -> list[Finding]:
        """Return that the tool is bent, or loose."""
        bent = self.moved if (self.moved_sigmas or 0.0) > SIGMAS else None
        loose = self.times if (self.times_sigmas or 0.0) > SIGMAS and (self.times or 0.0) > MIN_TIMES else None
        if bent is None and loose is None:
            return []
        return [finding("bad-tool", tool=self.tool, arms=self.arms, moved=bent, times=loose)]


def tools(tool_uses: Mapping[str, tuple[str, np.ndarray, float]]) -> list[ToolUse]:
    """Return what each tool's arms show.

    Args:
        used: arm → (tool, its position (3,) in the tip's frame [m], rms error of the calibrated arm [m]).
    """
    names = sorted({tool for tool, _, _ in tool_uses.values()})
    return [_use(name, tool_uses) for name in names]


def _use(name: str, tool_uses: Mapping[str, tuple[str, np.ndarray, float]]) -> ToolUse:
    arms = tuple(arm for arm, (tool, _, _) in tool_uses.items() if tool == name)
    other_arms = [arm for arm in tool_uses if arm not in arms]
    if len(arms) < MIN_ARMS[0] or len(other_arms) < MIN_ARMS[1]:
        return ToolUse(name, arms)
    groups = (arms, other_arms)
    positions = [np.array([tool_uses[arm][1] for arm in group]) for group in groups]
    errors = [np.log([[max(tool_uses[arm][2], 1e-9)] for arm in group]) for group in groups]
    displacement = np.median(positions[0], axis=0) - np.median(positions[1], axis=0)
    log_ratio = np.median(errors[0], axis=0) - np.median(errors[1], axis=0)
    return ToolUse(
        tool=name,
        arms=arms,
        moved=float(np.linalg.norm(displacement)),
        moved_sigmas=_sigmas(displacement, positions),
        times=float(np.exp(log_ratio[0])),
        times_sigmas=float(np.copysign(_sigmas(log_ratio, errors), log_ratio[0])),
    )


def _sigmas(step: np.ndarray, groups: Sequence[np.ndarray]) -> float:
    """Return how unlikely the difference `step` (k,) of two groups' medians is, as deviation of a normal variable.

    The scatter is that of the arms (n, k) about the median of their own group, as if all of it were along the
    difference: a tool's position scatters most along the last axis, where it cannot be told from the arm's last link.
    """
    away = [np.sort(np.linalg.norm(group - np.median(group, axis=0), axis=1)) for group in groups]
    typical = np.median(np.concatenate([group[1:] for group in away]))  # without the arm that is the median itself
    freedom = sum(len(group) - 1 for group in groups)
    variance = np.sum(np.minimum(np.concatenate(away), FAR * typical) ** 2) / freedom
    of_medians = sum(np.pi / (2.0 * (len(group) - 1) + np.pi) for group in groups)  # in variances of one arm, if normal
    square = float(step @ step) / max(variance, MIN_SCATTER**2) / of_medians
    return float(stats.norm.isf(max(stats.f.sf(square, 1, WORTH * freedom), 1e-300) / 2.0))
