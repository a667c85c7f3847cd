"""What a session that is done came to: its errors before and after, in one number each."""

from calib.procedure.session.folder import Session


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
    return max((one.raw.total for one in (unseen.validation or unseen.fit).values()), default=None)
