"""Tools of a fleet: is one that several arms share bent or loose, by what those arms show against all others?"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib.errors import Finding, finding
from calib.estimation import robust

MIN_ARMS = 2, 3  # with the tool, and with others, that a comparison needs (our choice)
SIGMAS = 3.0  # between medians, above it a tool is named (our choice)
MIN_TIMES = 1.5  # of the others' error, below it a tool is not called loose (our choice)


@dataclass(frozen=True)
class ToolUse:
    """What arms with one tool show, against arms of the same type with others.

    Attributes:
        tool: its name in the measurements (``tool`` of the options file).
        arms: their names.
        moved: distance of its median position from that of the others [m].
        moved_sigmas: the same in standard deviations of such a difference.
        times: median rms error, divided by that of the others.
        times_sigmas: its logarithm in standard deviations; all four are None where too few arms are compared.
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


def tools(used: Mapping[str, tuple[str, np.ndarray, float]]) -> list[ToolUse]:
    """Return what each tool's arms show.

    Args:
        used: arm → (tool, its position (3,) in the tip's frame [m], rms error of the calibrated arm [m]).
    """
    names = sorted({tool for tool, _, _ in used.values()})
    return [_use(name, used) for name in names]


def _use(name: str, used: Mapping[str, tuple[str, np.ndarray, float]]) -> ToolUse:
    arms = tuple(arm for arm, (tool, _, _) in used.items() if tool == name)
    others = [arm for arm in used if arm not in arms]
    if len(arms) < MIN_ARMS[0] or len(others) < MIN_ARMS[1]:
        return ToolUse(name, arms)
    (own, rest), errors = (
        [np.array([used[arm][1] for arm in group]) for group in (arms, others)],
        [np.log([max(used[arm][2], 1e-9) for arm in group]) for group in (arms, others)],
    )
    moved = float(np.linalg.norm(np.median(own, axis=0) - np.median(rest, axis=0)))
    times = float(np.median(errors[0]) - np.median(errors[1]))
    scatter = [_scatter(each - np.median(each, axis=0), len(arms)) for each in (rest, errors[1])]
    return ToolUse(name, arms, moved, moved / scatter[0], float(np.exp(times)), times / scatter[1])


def _scatter(left: Sequence[np.ndarray] | np.ndarray, count: int) -> float:
    """Return the standard deviation of the difference between the medians of `count` arms and of those of `left`."""
    of_median = np.sqrt(np.pi / 2.0)  # σ of a median, in that of a mean (normal distribution)
    min_scatter = 1e-6  # [m, or of a logarithm]
    own = max(robust.spread(np.asarray(left)), min_scatter)
    return float(of_median * own * np.sqrt(1.0 / count + 1.0 / len(left)))
