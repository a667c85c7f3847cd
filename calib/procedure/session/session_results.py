"""Folders of sessions, and errors of complete sessions, each as one number for nominal and calibrated robot."""

from collections.abc import Callable, Sequence
from pathlib import Path

from calib.errors import UsageError, require
from calib.procedure.session.folder import SETTINGS, Session


def _on_this_machine(address: str) -> list[str]:
    """Return no addresses, since a path on this machine names a single folder."""
    return []


def folders_of(
    given: str | Path | Sequence[str | Path], elsewhere: Callable[[str], list[str]] = _on_this_machine
) -> list[Path | str]:
    """Return the folders of sessions or fits, given as one or several folders, ``session.toml`` files or addresses.

    Args:
        given: what a person names.
        elsewhere: the addresses of the sessions at an address; empty for a path on this machine.

    Raises:
        UsageError: for a duplicate, or an empty list.
    """
    names = [given] if isinstance(given, (str, Path)) else given
    folders: list[Path | str] = []
    for name in names:
        path = Path(name)
        if path.name == SETTINGS:
            path = path.parent
        folders += elsewhere(str(name)) or [path]

    resolved = [folder.resolve() if isinstance(folder, Path) else folder for folder in folders]
    for folder, target in zip(folders, resolved):
        require(resolved.count(target) == 1, f"{folder} is given twice", UsageError)
    require(folders, "no session given; give folders or their session.toml", UsageError)
    return folders


def position_errors(session: Session) -> tuple[float, float] | None:
    """Return the rms errors of nominal and calibrated robot on the worst unseen poses [mm]; None without such."""
    if not session.geometric:
        return None
    metrics = session.validation.metrics()
    worst = None
    for rows in metrics.validation.values():
        before, after = rows.nominal.main, rows.judged(metrics.deliverable).main
        if before is None or after is None:
            continue
        if worst is None or after.rms > worst[1]:
            worst = before.rms, after.rms
    return worst


def torque_error(session: Session) -> float | None:
    """Return the share of the torque that is unexplained on the worst unseen motion [%]; None without dynamics."""
    if not session.dynamic:
        return None
    unseen = session.identification.unseen.read()
    scores = unseen.validation or unseen.fit
    return max((score.judged.total for score in scores.values()), default=None)
