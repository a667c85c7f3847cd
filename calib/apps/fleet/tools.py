"""Tools of a fleet: tests whether a tool that several arms share is bent or loose, against arms with other tools."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import fdtrc, ndtri

from calib.errors import Finding, finding

# smallest numbers of arms for a comparison: with the tool, and with other tools (our choice)
MIN_ARMS = 2, 3
# significance of the difference of medians, in sigmas, above which a tool is reported: 99 %, as for other findings
SIGMAS = 2.6
# distances from the median are limited to this multiple of the typical distance (our choice)
MAX_DISTANCE = 3.0
# share of the degrees of freedom that remains after this limitation (our choice)
FREEDOM_SHARE = 0.8
# smallest scatter, of positions [m] and of logarithms of errors
MIN_SCATTER = 1e-6
# smallest ratio of the arms' error with a loose tool to the error of the other arms (our choice)
MIN_TIMES = 1.5


@dataclass(frozen=True)
class ToolUse:
    """Comparison of arms with one tool against arms of the same type with other tools.

    `moved`, `moved_sigmas`, `times` and `times_sigmas` are None where there are too few arms.

    Attributes:
        tool: the tool's name in the measurements (``tool`` in the options file).
        arms: names of the arms with this tool.
        moved: distance between the tool's median position and that of the other tools [m].
        moved_sigmas: significance of `moved`: the deviation, in σ, of a normal variable with the same probability,
            given the scatter among arms with one tool.
        times: median rms error of these arms, divided by that of the other arms.
        times_sigmas: significance of log(times), defined as for `moved_sigmas`.
    """

    tool: str
    arms: tuple[str, ...]
    moved: float | None = None
    moved_sigmas: float | None = None
    times: float | None = None
    times_sigmas: float | None = None

    def findings(self) -> list[Finding]:
        """Return the finding that the tool is bent or loose; an empty list where it is neither."""
        bent = loose = None
        if self.moved_sigmas is not None and self.moved_sigmas > SIGMAS:
            bent = self.moved
        if self.times_sigmas is not None and self.times_sigmas > SIGMAS and (self.times or 0.0) > MIN_TIMES:
            loose = self.times
        if bent is None and loose is None:
            return []
        return [finding("bad-tool", tool=self.tool, arms=self.arms, moved=bent, times=loose)]


def tools(tool_uses: Mapping[str, tuple[str, np.ndarray, float]]) -> list[ToolUse]:
    """Return the comparison of each tool with the other tools.

    Args:
        tool_uses: arm to (tool, the tool's position (3,) in the tip's frame [m], rms error of the calibrated arm [m]).
    """
    names = sorted({tool for tool, _, _ in tool_uses.values()})
    return [_use(name, tool_uses) for name in names]


def _use(name: str, tool_uses: Mapping[str, tuple[str, np.ndarray, float]]) -> ToolUse:
    arms = []
    other_arms = []
    for arm, (tool, _, _) in tool_uses.items():
        if tool == name:
            arms.append(arm)
        else:
            other_arms.append(arm)
    if len(arms) < MIN_ARMS[0] or len(other_arms) < MIN_ARMS[1]:
        return ToolUse(name, tuple(arms))

    positions = []
    log_errors = []
    for group in (arms, other_arms):
        positions.append(np.array([tool_uses[arm][1] for arm in group]))
        # an error of zero has no logarithm
        log_errors.append(np.log([[max(tool_uses[arm][2], 1e-9)] for arm in group]))
    displacement = np.median(positions[0], axis=0) - np.median(positions[1], axis=0)
    log_ratio = np.median(log_errors[0], axis=0) - np.median(log_errors[1], axis=0)
    return ToolUse(
        tool=name,
        arms=tuple(arms),
        moved=float(np.linalg.norm(displacement)),
        moved_sigmas=_sigmas(displacement, positions),
        times=float(np.exp(log_ratio[0])),
        times_sigmas=float(np.copysign(_sigmas(log_ratio, log_errors), log_ratio[0])),
    )


def _sigmas(step: np.ndarray, groups: Sequence[np.ndarray]) -> float:
    """Return the significance, in σ of a normal variable, of the difference `step` (k,) between two groups' medians.

    The scatter is estimated from the deviations of the arms from the median of their group. All of it is taken to be
    along the difference: a tool's position scatters most along the last axis, where it cannot be separated from the
    arm's last link.

    Args:
        step: (k,) difference of the two medians, such as of positions (k = 3) [m].
        groups: the groups, each (n, k) with one row per arm.
    """
    distances = []
    freedom = 0
    variance_of_medians = 0.0
    for group in groups:
        deviations = group - np.median(group, axis=0)
        distances.append(np.sort(np.linalg.norm(deviations, axis=1)))
        freedom += len(group) - 1
        # in variances of one arm, if normal
        variance_of_medians += np.pi / (2.0 * (len(group) - 1) + np.pi)
    # without the arm that is the median itself
    typical = np.median(np.concatenate([group[1:] for group in distances]))
    limited = np.minimum(np.concatenate(distances), MAX_DISTANCE * typical)
    variance = np.sum(limited**2) / freedom
    square = float(step @ step) / max(variance, MIN_SCATTER**2) / variance_of_medians
    probability = max(fdtrc(1, FREEDOM_SHARE * freedom, square), 1e-300)
    return -float(ndtri(probability / 2.0))
