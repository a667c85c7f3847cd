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
    visits_by_arm: dict[str, list[Visit]] = {}
    for calibration_place in places:
        waits = calibration_place.session and calibration_place.session.geometric and not calibration_place.fit
        require(
            calibration_place.fit or waits,
            f"a fleet's report takes fitted geometries, but {calibration_place.words}",
            UsageError,
        )
        calibration = None if waits else read_fit(calibration_place)
        if calibration is None or (calibration_place.session and not calibration.judged[0]):
            unfinished.append(calibration_place.name)
        else:
            visits_by_arm.setdefault(calibration.serial or calibration.name, []).append(
                (calibration_place, calibration)
            )
    finished_count = len(places) - len(unfinished)
    message = f"sessions without a verdict yet: {listing(unfinished)}; {finished_count} of {len(places)} left, nothing to compare"
    require(
        finished_count > 1 or not unfinished, f"{message} (calib next, or calib run, goes on with them)", UsageError
    )
    unnamed = [
        calibration.name
        for arm_visits in visits_by_arm.values()
        for _, calibration in arm_visits
        if not calibration.serial
    ]
    noticed = [finding("sessions-unfinished", sessions=unfinished)] if unfinished else []
    noticed += [finding("arms-without-serial", arms=unnamed)] if len(unnamed) > 1 else []
    noticed += [_current(arm, arm_visits) for arm, arm_visits in visits_by_arm.items() if len(arm_visits) > 1]
    return Visits(
        {arm: [calibration for _, calibration in _in_time(arm_visits)] for arm, arm_visits in visits_by_arm.items()},
        tuple(noticed),
    )


def _dates(arm_visits: Sequence[Visit]) -> tuple[str, list[date]]:
    """Return what the dates of one arm's calibrations are of, and the dates; none where some are not known.

    Dates of measurement where any is stated, else those on which the sessions were made.
    """
    settings = [visit_place.session.settings for visit_place, _ in arm_visits if visit_place.session]
    measured_dates = [session_settings.certificate.measured_on for session_settings in settings]
    source, texts = (
        ("measurement", measured_dates)
        if any(measured_dates)
        else ("the session", [session_settings.created for session_settings in settings])
    )
    with suppress(ValueError):
        parsed = [datetime.fromisoformat(text).date() for text in texts]
        return source, parsed if len(parsed) == len(arm_visits) else []
    return source, []


def _in_time(arm_visits: Sequence[Visit]) -> list[Visit]:
    """Return one arm's calibrations, earliest first; those of one day, and those without dates, as they were given."""
    _, dates = _dates(arm_visits)
    return [arm_visits[k] for k in sorted(range(len(arm_visits)), key=dates.__getitem__)] if dates else list(arm_visits)


def _current(arm: str, arm_visits: Sequence[Visit]) -> Finding:
    """Return which of one arm's calibrations is taken as the current one, and why."""
    source, dates = _dates(arm_visits)
    current, last = _in_time(arm_visits)[-1][1].name, arm_visits[-1][1].name
    dated = dates.count(max(dates)) == 1 if dates else False
    return finding(
        "current-calibration",
        arm=arm,
        current=current,
        date=str(max(dates)) if dated else "",
        how=f"date of {source}" if dated else "the order given",
        last=last if last != current else "",
        needed="" if dated else "measured_on",
    )
