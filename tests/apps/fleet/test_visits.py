"""Calibrations of a fleet by arm: unfinished sessions are left out, and dates say which calibration is current."""

from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest

from calib.apps.fleet import visits
from calib.errors import Finding, UsageError

DATES = {"a": "2026-06-15", "b": "2026-01-15", "c": "2025-03-02"}


@dataclass(frozen=True)
class Fitted:
    name: str
    judged: tuple[str, str]
    serial: str


@pytest.fixture
def given(monkeypatch: pytest.MonkeyPatch):
    """Return what `visits` finds of sessions (name → serial number, measured_on, created, verdict; None: no fit)."""

    def found(rows: dict[str, tuple[str, str, str, str | None]]) -> tuple[dict[str, list[str]], dict[str, Finding]]:
        def place(name: Path, verb: str) -> visits.Place:
            _, measured, created, verdict = rows[str(name)]
            stated = SimpleNamespace(certificate=SimpleNamespace(measured_on=measured), created=created)
            session, fit = SimpleNamespace(settings=stated, geometric=True), None if verdict is None else "4-fit"
            return visits.Place(str(name), session, fit)  # type: ignore[arg-type]

        def fitted(one: visits.Place) -> Fitted:
            return Fitted(one.name, (rows[one.name][3] or "", ""), rows[one.name][0])

        monkeypatch.setattr(visits, "place_of", place)
        monkeypatch.setattr(visits, "read_fit", fitted)
        result = visits.visits(list(rows))
        names = {arm: [one.name for one in own] for arm, own in result.by_arm.items()}
        return names, {one.code: one for one in result.noticed}

    return found


def test_latest_date_is_current(given) -> None:
    """The latest date is current, in whatever order they are given."""
    by_arm, noticed = given({name: ("R7", DATES[name], "2026-11-27T10:00:00+00:00", "pass") for name in "abc"})
    assert by_arm == {"R7": ["c", "b", "a"]}
    told = noticed["current-calibration"].values
    assert (told["current"], told["date"], told["last"]) == ("a", "2026-06-15", "c")
    by_arm, noticed = given({name: ("R7", "", f"{DATES[name]}T10:00:00+00:00", "pass") for name in "abc"})
    assert by_arm == {"R7": ["c", "b", "a"]} and "session" in noticed["current-calibration"].values["how"]


@pytest.mark.parametrize("dates", [("2026-06-15", ""), ("15.6.2026", "2026-01-15"), ("2026-01-15", "2026-01-15")])
def test_unordered_dates_keep_given_order(given, dates: tuple[str, str]) -> None:
    """Dates that tell no order leave it as given."""
    by_arm, noticed = given(
        {name: ("R7", date, "2026-11-27T10:00:00+00:00", "pass") for name, date in zip("ab", dates)}
    )
    told = noticed["current-calibration"].values
    assert by_arm == {"R7": ["a", "b"]} and told["how"] == "the order given" and told["needed"] == "measured_on"


def test_unfinished_sessions_are_left_out(given) -> None:
    """Also one whose fit is there and not judged; refused where fewer than two are left."""
    rows = {"a": ("", "", "", "pass"), "b": ("", "", "", "fail"), "c": ("", "", "", None), "d": ("", "", "", "")}
    by_arm, noticed = given(rows)
    assert list(by_arm) == ["a", "b"] and noticed["sessions-unfinished"].values["sessions"] == ("c", "d")
    assert noticed["arms-without-serial"].values["arms"] == ("a", "b")
    del rows["b"]
    with pytest.raises(UsageError, match="c, d; 1 of 3 have one"):
        given(rows)
