"""What ``metrics.json`` of a designed motion holds, as far as a report needs it."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass


@dataclass(frozen=True)
class DesignCondition:
    """Condition number of the observation matrix, in its units and with columns of unit norm.

    Where motions before count, too: of this motion alone, and of those before it.
    """

    raw: float
    normalised: float
    raw_alone: float | None = None
    normalised_alone: float | None = None
    raw_before: float | None = None
    normalised_before: float | None = None

    def table(self) -> dict[str, float]:
        """Return the entry of ``metrics.json``."""
        return {name: value for name, value in asdict(self).items() if value is not None}


@dataclass(frozen=True)
class _DesignSetting:
    """What was asked for: period [s], the columns to identify, and how many instants were verified."""

    period: float
    columns: tuple[str, ...]
    instants_verified: int


@dataclass(frozen=True)
class _LimitMargin:
    """What is left of a limit, as a share of its scale."""

    share: float


@dataclass(frozen=True)
class DesignMetrics:
    """The content of ``metrics.json``: condition number, what was asked for, the smallest margin of each limit."""

    condition_number: DesignCondition
    setting: _DesignSetting
    margins: Mapping[str, _LimitMargin]
