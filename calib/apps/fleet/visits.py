"""Finished calibrations of a fleet, grouped by arm (serial number) and sorted by date."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date, datetime
from pathlib import Path

from calib.apps.monitoring.comparison.calibration_sources import Place, place_of
from calib.apps.monitoring.comparison.geometry_calibration import Calibration, read_fit
from calib.errors import Finding, UsageError, finding, listing, require
from calib.result_kinds import refusal
from calib.toolkit.sessions import folders_of

Visit = tuple[Place, Calibration]


@dataclass(frozen=True, eq=False)
class Visits:
    """The finished calibrations of a fleet.

    Attributes:
        by_arm: serial number to that arm's calibrations, earliest first; a calibration without a serial number has its
            name as the key.
        noticed: findings on calibrations that were left out, that count as separate arms, or that are taken as an arm's
            current calibration.
    """

    by_arm: Mapping[str, Sequence[Calibration]]
    noticed: tuple[Finding, ...]


def visits(calibrations: str | Path | Sequence[str | Path]) -> Visits:
    """Return the finished calibrations by arm; sessions whose geometry has no verdict yet are left out and named.

    Args:
        calibrations: folders of fits or sessions.

    Raises:
        UsageError: a folder without a fit or given twice, or fewer than two finished calibrations.
    """
    places = [place_of(folder, "fleet") for folder in folders_of(calibrations)]
    unfinished: list[str] = []
    visits_by_arm: dict[str, list[Visit]] = {}
    for source in places:
        require(not source.nominal, refusal(source.name, "fleet"), UsageError)
        session = source.session
        waits = session and session.geometric and not source.fit
        require(source.fit or waits, f"a fleet's report takes fitted geometries, but {source.words}", UsageError)
        if waits:
            unfinished.append(source.name)
            continue
        calibration = read_fit(source)
        if session and not calibration.judged[0]:
            unfinished.append(source.name)
            continue
        arm = calibration.serial or calibration.name
        visits_by_arm.setdefault(arm, []).append((source, calibration))

    finished_count = len(places) - len(unfinished)
    counts = f"{finished_count} of {len(places)} have one, too few to compare"
    message = f"sessions without a verdict yet: {listing(unfinished)}; {counts}"
    enough = finished_count > 1 or not unfinished
    require(enough, f"{message}; continue them with calib next or calib run", UsageError)

    unnamed = []
    current = []
    by_arm = {}
    for arm, arm_visits in visits_by_arm.items():
        unnamed += [calibration.name for _, calibration in arm_visits if not calibration.serial]
        if len(arm_visits) > 1:
            current.append(_current(arm, arm_visits))
        by_arm[arm] = [calibration for _, calibration in _in_time(arm_visits)]

    noticed = []
    if unfinished:
        noticed.append(finding("sessions-unfinished", sessions=unfinished))
    if len(unnamed) > 1:
        noticed.append(finding("arms-without-serial", arms=unnamed))
    return Visits(by_arm, (*noticed, *current))


def _dates(arm_visits: Sequence[Visit]) -> tuple[str, list[date]]:
    """Return the kind of dates by which one arm's calibrations are sorted, and the dates.

    The kind is "measurement" if any calibration has a date of measurement, otherwise "the session" (the date on which
    the session was created). The list of dates is empty if a calibration has no such date.

    Args:
        arm_visits: the arm's calibrations.
    """
    settings = [source.session.settings for source, _ in arm_visits if source.session]
    dated_thing = "measurement"
    texts = [session_settings.certificate.measured_on for session_settings in settings]
    if not any(texts):
        dated_thing = "the session"
        texts = [session_settings.created for session_settings in settings]
    try:
        dates = [datetime.fromisoformat(text).date() for text in texts]
    except ValueError:
        return dated_thing, []
    if len(dates) != len(arm_visits):
        return dated_thing, []
    return dated_thing, dates


def _in_time(arm_visits: Sequence[Visit]) -> list[Visit]:
    """Return one arm's calibrations, earliest first.

    Calibrations of one day remain in the given order; so do all of them where dates are missing.

    Args:
        arm_visits: the arm's calibrations in the order given by the user.
    """
    _, dates = _dates(arm_visits)
    if not dates:
        return list(arm_visits)
    order = sorted(range(len(arm_visits)), key=dates.__getitem__)
    return [arm_visits[k] for k in order]


def _current(arm: str, arm_visits: Sequence[Visit]) -> Finding:
    """Return the finding that names the calibration taken as an arm's current one, and the reason.

    Args:
        arm: serial number of the arm.
        arm_visits: its calibrations in the order given by the user.
    """
    dated_thing, dates = _dates(arm_visits)
    current = _in_time(arm_visits)[-1][1].name
    last = arm_visits[-1][1].name
    date_text = ""
    reason = "the order given"
    needed = "measured_on"
    if dates:
        latest = max(dates)
        date_text = str(latest)
        # Two calibrations of the latest day are in the order given.
        if dates.count(latest) == 1:
            reason = f"date of {dated_thing}"
            needed = ""
        else:
            date_text = ""
    if last == current:
        last = ""
    return finding(
        "current-calibration", arm=arm, current=current, date=date_text, how=reason, last=last, needed=needed
    )
