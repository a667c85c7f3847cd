"""Responses that pages of a served session have in common, and the kinds of files that it takes."""

from pathlib import Path

from starlette.requests import Request
from starlette.responses import HTMLResponse, RedirectResponse, Response

from calib.errors import UsageError, complaint, require
from calib.toolkit.report_pages import filled, read_template
from calib.toolkit.sessions import BROUGHT, Session, open_session, steps_of

TEMPLATES = "calib.apps.serve"
DRIFT = "the first poses measured again at the end, to check for drift (optional)"
OURS = "default-src 'none'; style-src 'unsafe-inline'; script-src 'self'; connect-src 'self'; img-src 'self' data:"
POLICY = f"{OURS}; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
MEASURED_KINDS = ("measured", "validation", "drift")


def page_of(template: str, status: int = 200, **values: object) -> Response:
    """Return a page made from a template of this package."""
    headers = {"Content-Security-Policy": POLICY, "Cache-Control": "no-store"}
    served = read_template(TEMPLATES, "served.css")
    return HTMLResponse(filled(TEMPLATES, template, **values, served=served), status, headers)


def refused(request: Request, error: Exception) -> Response:
    """Return a page that shows the message of the error that a request caused."""
    message = str(error)
    foreseen = complaint(error)
    if foreseen:
        message = foreseen[0]
    return page_of("refused.html", 400, message=message)


def back(part: str = "") -> Response:
    """Return a redirection to the session's page, or to one of its parts by its id."""
    return RedirectResponse(f"/#{part}" if part else "/", 303)


def session_of(request: Request) -> Session:
    """Return the served session, read anew from its folder."""
    return open_session(request.app.state.work.folder)


def kinds_of(session: Session) -> dict[str, str]:
    """Return the kinds of files that can be uploaded to a session, each with its description."""
    labels = dict(step.brings for step in steps_of(session))
    if session.geometric:
        labels["drift"] = DRIFT
    return {kind: labels[kind] for kind in BROUGHT if kind in labels}


def kind_of(request: Request, session: Session) -> str:
    """Return the kind of files that a request's path names.

    Raises:
        UsageError: the session takes no such files.
    """
    kind = request.path_params["kind"]
    require(kind in kinds_of(session), "this session does not accept such files", UsageError)
    return kind


def name_of(session: Session, path: Path) -> str:
    """Return the path of a file relative to the session's folder."""
    return str(path.relative_to(session.folder))
