"""Sessions by their folders, and what one that is done came to: errors before and after, in one number each."""

from collections.abc import Callable, Sequence
from pathlib import Path

from calib.errors import UsageError, require
from calib.procedure.session.folder import SETTINGS, Session


def folders_of(
    given: str | Path | Sequence[str | Path], elsewhere: Callable[[str], list[str]] = lambda address: []
) -> list[Path | str]:
    """Return the folders of sessions or fits, given as one or several folders, ``session.toml`` files or addresses.

    Args:
        given: what a person names.
        elsewhere: the addresses of the sessions at an address; empty for a path on this machine.

    Raises:
        UsageError: for a duplicate, or an empty list.
    """
    found = list[Path | str]()
    for each in [given] if isinstance(given, (str, Path)) else given:
        path = Path(each)
        found += elsewhere(str(each)) or [path.parent if path.name == SETTINGS else path]
    real = [one.resolve() if isinstance(one, Path) else one for one in found]
    twice = [path for path, own in zip(found, real) if real.count(own) > 1]
    require(not twice, f"{next(iter(twice), '')} is given twice", UsageError)
    require(found, "no session given; give folders or their session.toml", UsageError)
    return found


def position_errors(session: Session) -> tuple[float, float] | None:
    """Return the rms errors of nominal and calibrated robot on the worst unseen poses [mm]; None without such."""
    if not session.geometric:
        return None
    found = session.validation.metrics()
    pairs = [(one.nominal.main, one.judged(found.deliverable).main) for one in found.validation.values()]
    rms = [(before.rms, after.rms) for before, after in pairs if before is not None and after is not None]
    return max(rms, key=lambda pair: pair[1], default=None)


def torque_error(session: Session) -> float | None:
    """Return the share of the torque that is unexplained on the worst unseen motion [%]; None without dynamics."""
    if not session.dynamic:
        return None
    unseen = session.identification.unseen.read()
    return max((one.judged.total for one in (unseen.validation or unseen.fit).values()), default=None)
