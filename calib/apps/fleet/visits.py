"""Calibrations of a fleet by arm: which are finished, which are of one arm, and in what order of time."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import date, datetime
from pathlib import Path

from calib.apps.monitoring.comparison.calibrations import Calibration, read_fit
from calib.apps.monitoring.comparison.places import Place, place_of
from calib.errors import Finding, UsageError, finding, listing, require
from calib.procedure.session.results import folders_of

Visit = tuple[Place, Calibration]


@dataclass(frozen=True, eq=False)
class Visits:
    """The finished calibrations of a fleet.

    Attributes:
        by_arm: serial number, or the name of a calibration that states none → that arm's calibrations, earliest first.
        noticed: what was left out, counts as an arm of its own, or is taken as an arm's current calibration.
    """

    by_arm: Mapping[str, Sequence[Calibration]]
    noticed: tuple[Finding, ...]


def visits(calibrations: str | Path | Sequence[str | Path]) -> Visits:
    """Return the finished calibrations by arm; sessions whose geometry has no verdict yet are left out and named.

    Args:
        calibrations: folders of fits or sessions.

    Raises:
        UsageError: for a folder that holds no fit, or one given twice; where one or none is left.
    """
    places, unfinished = [place_of(folder, "fleet") for folder in folders_of(calibrations)], list[str]()
    own: dict[str, list[Visit]] = {}
    for place in places:
        waits = place.session and place.session.geometric and not place.fit
        require(place.fit or waits, f"a fleet's report takes fitted geometries, but {place.words}", UsageError)
        one = None if waits else read_fit(place)
        if one is None or (place.session and not one.judged[0]):
            unfinished.append(place.name)
        else:
            own.setdefault(one.serial or one.name, []).append((place, one))
    left = len(places) - len(unfinished)
    words = f"sessions without a verdict yet: {listing(unfinished)}; {left} of {len(places)} left, nothing to compare"
    require(left > 1 or not unfinished, f"{words} (calib next, or calib run, goes on with them)", UsageError)
    unnamed = [one.name for each in own.values() for _, one in each if not one.serial]
    noticed = [finding("sessions-unfinished", sessions=unfinished)] if unfinished else []
    noticed += [finding("arms-without-serial", arms=unnamed)] if len(unnamed) > 1 else []
    noticed += [_current(arm, each) for arm, each in own.items() if len(each) > 1]
    return Visits({arm: [one for _, one in _in_time(each)] for arm, each in own.items()}, tuple(noticed))


def _dates(own: Sequence[Visit]) -> tuple[str, list[date]]:
    """Return what the dates of one arm's calibrations are of, and the dates; none where some are not known.

    Dates of measurement where any is stated, else those on which the sessions were made.
    """
    settings = [place.session.settings for place, _ in own if place.session]
    stated = [one.certificate.measured_on for one in settings]
    what, texts = ("measurement", stated) if any(stated) else ("the session", [one.created for one in settings])
    with suppress(ValueError):
        found = [datetime.fromisoformat(text).date() for text in texts]
        return what, found if len(found) == len(own) else []
    return what, []


def _in_time(own: Sequence[Visit]) -> list[Visit]:
    """Return one arm's calibrations, earliest first; those of one day, and those without dates, as they were given."""
    _, dates = _dates(own)
    return [own[k] for k in sorted(range(len(own)), key=dates.__getitem__)] if dates else list(own)


def _current(arm: str, own: Sequence[Visit]) -> Finding:
    """Return which of one arm's calibrations is taken as the current one, and why."""
    what, dates = _dates(own)
    current, given = _in_time(own)[-1][1].name, own[-1][1].name
    dated = dates.count(max(dates)) == 1 if dates else False
    return finding(
        "current-calibration",
        arm=arm,
        current=current,
        date=str(max(dates)) if dated else "",
        how=f"date of {what}" if dated else "the order given",
        last=given if given != current else "",
        needed="" if dated else "measured_on",
    )
