"""What ``metrics.json`` of a designed motion holds, as far as a report needs it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class DesignCondition:
    """Condition number of the observation matrix, in its units and with columns of unit norm."""

    raw: float
    normalised: float


@dataclass(frozen=True)
class DesignSetting:
    """What was asked for: period [s], the columns to tell, and how many instants were verified."""

    period: float
    columns: tuple[str, ...]
    instants_verified: int


@dataclass(frozen=True)
class LimitMargin:
    """What is left of a limit, as a share of its scale."""

    share: float


@dataclass(frozen=True)
class DesignMetrics:
    """The content of ``metrics.json``: condition number, what was asked for, the smallest margin of each limit."""

    condition_number: DesignCondition
    setting: DesignSetting
    margins: Mapping[str, LimitMargin]
