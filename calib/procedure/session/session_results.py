"""Folders of sessions, and the position and torque errors of complete sessions as single numbers."""

from collections.abc import Callable, Sequence
from pathlib import Path

from calib.errors import UsageError, require
from calib.procedure.session.folder import SETTINGS, Session


def _on_this_machine(address: str) -> list[str]:
    """Return an empty list: `address` is a path on this machine and thus a single folder."""
    return []


def folders_of(
    given: str | Path | Sequence[str | Path], elsewhere: Callable[[str], list[str]] = _on_this_machine
) -> list[Path | str]:
    """Return the folders of sessions or fits.

    Args:
        given: one or several folders, ``session.toml`` files or addresses, as stated by the user.
        elsewhere: function that returns the addresses of all sessions at an address; empty for a path on this machine.

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
    """Return the rms position errors [mm] of nominal and calibrated robot on a session's held-out poses.

    Of several sets of poses, the one with the largest error is used. None without a fit or held-out poses.
    """
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
    """Return the unexplained share of the torque [%] on a session's held-out motion with the largest error.

    Without held-out motion, the error on the training motion; None without dynamics.
    """
    if not session.dynamic:
        return None
    unseen = session.identification.unseen.read()
    scores = unseen.validation or unseen.fit
    return max((score.judged.total for score in scores.values()), default=None)
