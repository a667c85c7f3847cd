"""The web pages of a served session, and the check of who may request them."""

import atexit
import hmac
import ipaddress
import re
import socket
from pathlib import Path
from urllib.parse import urlsplit

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, HTMLResponse, PlainTextResponse, RedirectResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Receive, Scope, Send

from calib.apps.serve import uploads
from calib.apps.serve.web_viewer import LOCAL, WebViewer
from calib.apps.serve.work import CHECK, NEXT, REDO, Work
from calib.apps.viewer.viewer import FILE as RECORDING
from calib.errors import CalibError, complaint
from calib.folders import PAGES
from calib.toolkit.report_pages import filled
from calib.toolkit.sessions import (
    BROUGHT,
    DONE,
    KEPT,
    WAITING,
    Session,
    asks,
    clear_staging,
    find_step,
    open_session,
    read_state,
    step_states,
    steps_of,
)

TEMPLATES = "calib.apps.serve"
DRIFT = "the first poses measured again at the end, to check for drift (optional)"
PICTURES = (".png", ".svg")
OURS = "default-src 'none'; style-src 'unsafe-inline'; script-src 'self'; connect-src 'self'; img-src 'self' data:"
POLICY = f"{OURS}; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
# of files, whoever wrote them
SANDBOX = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; sandbox"


class Guard:
    """Middleware that refuses requests without the token.

    It also refuses requests for another host name (DNS rebinding), and POST requests from other sites' pages.

    Args:
        app: the web application.
        token: the token; empty: none is required.
        host: host name that is accepted besides numeric addresses and this computer's names.
    """

    def __init__(self, app: ASGIApp, token: str, host: str) -> None:
        self.app = app
        self.token = token
        name = socket.gethostname()
        names = ("localhost", host, name, f"{name}.local", socket.getfqdn())
        self.names = {name.lower() for name in names}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        responder = self.app
        if scope["type"] == "http":
            responder = self._answer(Request(scope)) or self.app
        await responder(scope, receive, send)

    def _answer(self, request: Request) -> Response | None:
        """Return the response to a refused request, or to one that sets the token's cookie; None for other requests."""
        requested_host = request.headers.get("host", "")
        if not self._is_ours(requested_host):
            return PlainTextResponse(
                "This page is not served under this host name: open the address that calib serve printed.", 403
            )
        if request.method != "GET":
            origin = request.headers.get("origin")
            other_origin = origin is not None and urlsplit(origin).netloc != requested_host
            site = request.headers.get("sec-fetch-site", "same-origin")
            if other_origin or site not in ("same-origin", "none"):
                return PlainTextResponse("Another site's page asked for this; nothing was changed.", 403)
        cookie = f"calib-{urlsplit(f'//{requested_host}').port or 80}"
        if self.token and not self._knows(request.cookies.get(cookie, "")):
            if request.method != "GET" or not self._knows(request.query_params.get("token", "")):
                message = "This page needs its token: open the whole address that calib serve printed."
                return PlainTextResponse(message, 403)
            answer = RedirectResponse(request.url.path, 303)
            answer.set_cookie(cookie, self.token, httponly=True, samesite="strict")
            return answer
        return None

    def _is_ours(self, requested_host: str) -> bool:
        try:
            name = urlsplit(f"//{requested_host}").hostname or ""
        except ValueError:
            return False
        try:
            # Nobody can rebind a number.
            ipaddress.ip_address(name)
            return True
        except ValueError:
            return name in self.names

    def _knows(self, token: str) -> bool:
        return hmac.compare_digest(token.encode(), self.token.encode())


def application(work: Work, token: str = "", host: str = "127.0.0.1") -> Starlette:
    """Return the web application of a session.

    Args:
        work: the session's worker.
        token: token required in every request; empty: none.
        host: host name accepted besides numeric addresses and this computer's names.
    """
    clear_staging(open_session(work.folder))
    routes = [
        Route("/", page),
        Route("/page.js", script),
        Route("/files/{name:path}", file),
        Route("/view", view),
        Route("/next", go_on, methods=["POST"]),
        Route("/redo/{step}", go_on, methods=["POST"]),
        Route("/bring/{kind}", bring, methods=["POST"]),
        Route("/aside/{name:path}", set_aside, methods=["POST"]),
    ]
    guard = Middleware(Guard, token=token, host=host)  # type: ignore[arg-type]
    errors = {CalibError: refused, OSError: refused}
    app = Starlette(routes=routes, middleware=[guard], exception_handlers=errors)  # type: ignore[arg-type]
    app.state.work = work
    app.state.view = WebViewer()
    atexit.register(app.state.view.close)
    return app


def refused(request: Request, error: Exception) -> Response:
    """Return a page that shows the message of the error that a request caused."""
    message = str(error)
    foreseen = complaint(error)
    if foreseen:
        message = foreseen[0]
    html = filled(TEMPLATES, "refused.html", message=message)
    return HTMLResponse(html, 400, {"Content-Security-Policy": POLICY})


def page(request: Request) -> Response:
    """Return the page with the current state of the session."""
    work: Work = request.app.state.work
    session = open_session(work.folder)
    states = step_states(session)
    ahead = None
    for state in states:
        if state.kind not in (DONE, KEPT):
            ahead = state
            break
    task = to_bring = ""
    if ahead is not None and ahead.kind == WAITING:
        task, to_bring = asks(session, ahead)
    verdicts = None
    if ahead is None:
        verdicts = session.verdicts()
    recording = ""
    if session.path(RECORDING).exists():
        recording = RECORDING
    paths = _files(session)
    tasks = [re.sub(r"^\d+ ", "", line) for line in task.splitlines()]
    pictures = [_name(session, path) for path in paths if path.suffix in PICTURES]
    file_names = [_name(session, path) for path in paths]
    values = {
        "session": session,
        "states": states,
        "ahead": ahead,
        "work": work,
        "to_bring": to_bring,
        "tasks": tasks,
        "verdicts": verdicts,
        "kinds": _kinds(session),
        "notes": _notes(session),
        "pages": _pages(session),
        "recording": recording,
        "pictures": pictures,
        "files": file_names,
    }
    headers = {"Content-Security-Policy": POLICY, "Cache-Control": "no-store"}
    return HTMLResponse(filled(TEMPLATES, "page.html", **values), headers=headers)


def _pages(session: Session) -> list[str]:
    return [name for name in PAGES if session.path(name).exists()]


def _notes(session: Session) -> dict[str, tuple[str, ...]]:
    return {name: record.notes for name, record in read_state(session).steps.items()}


def _kinds(session: Session) -> list[tuple[str, str, list[str]]]:
    """Return the kinds of files that can be uploaded to the session: name, description, and paths of existing files."""
    labels = dict(step.brings for step in steps_of(session))
    if session.geometric:
        labels["drift"] = DRIFT
    kinds = []
    for kind in BROUGHT:
        if kind in labels:
            paths = [_name(session, path) for path in session.brought(kind)]
            kinds.append((kind, labels[kind], paths))
    return kinds


def _name(session: Session, path: Path) -> str:
    return str(path.relative_to(session.folder))


def _files(session: Session) -> list[Path]:
    """Return the session's files, without hidden ones."""
    visible = []
    for path in sorted(session.folder.rglob("*")):
        parts = path.relative_to(session.folder).parts
        hidden = any(part.startswith(".") for part in parts)
        if path.is_file() and not hidden:
            visible.append(path)
    return visible


def script(request: Request) -> Response:
    """Return the page's script; the page also works without the script."""
    return FileResponse(Path(__file__).with_name("page.js"))


def file(request: Request) -> Response:
    """Return the file of the session's folder that the request's path names."""
    session = open_session(request.app.state.work.folder)
    path = session.folder / request.path_params["name"]
    if path not in _files(session) or not path.resolve().is_relative_to(session.folder.resolve()):
        return PlainTextResponse("no such file in this session", 404)
    headers = {"X-Content-Type-Options": "nosniff", "Cache-Control": "no-cache"}
    # Viewers of PDF are scripts, which a sandbox would stop.
    if path.suffix != ".pdf":
        headers["Content-Security-Policy"] = SANDBOX
    return FileResponse(path, headers=headers)


def view(request: Request) -> Response:
    """Redirect to the 3-D view of the session's recording.

    This works only for browsers on this computer, since Rerun's server listens only there.
    """
    recording = open_session(request.app.state.work.folder).path(RECORDING)
    if not recording.exists():
        return PlainTextResponse("no recording yet", 404)
    if request.client is None or request.client.host not in LOCAL:
        return PlainTextResponse(f"The 3-D view is for the computer that serves; download {RECORDING} here.", 403)
    return RedirectResponse(request.app.state.view.address_of(recording), 303)


def go_on(request: Request) -> Response:
    """Start a run of `calib next`, or of `calib redo` if the request's path contains a step.

    The request is ignored while a run is in progress.
    """
    work = request.app.state.work
    step = request.path_params.get("step", "")
    task = NEXT
    if step:
        find_step(open_session(work.folder), step)
        task = REDO
    work.ask(task, step)
    return RedirectResponse("/", 303)


async def bring(request: Request) -> Response:
    """Store the files of an uploaded form in the session's folder, and queue their check."""
    work = request.app.state.work
    kind = request.path_params["kind"]
    session = open_session(work.folder)
    if kind not in [name for name, _, _ in _kinds(session)]:
        return PlainTextResponse("this session does not accept such files", 404)
    try:
        await uploads.receive(session, kind, request.headers.get("content-type", ""), request.stream())
    except ClientDisconnect:
        return PlainTextResponse("interrupted; nothing was stored", 400)
    work.ask(CHECK, kind)
    return RedirectResponse("/", 303)


def set_aside(request: Request) -> Response:
    """Move the uploaded file of the request into the subfolder ``aside``, where the session does not read it."""
    work = request.app.state.work
    name = request.path_params["name"]
    session = open_session(work.folder)
    for kind, _, names in _kinds(session):
        if name in names:
            path = session.path(name)
            aside = path.parent / "aside"
            aside.mkdir(exist_ok=True)
            path.replace(aside / f"{len(list(aside.iterdir())) + 1}_{path.name}")
            work.ask(CHECK, kind)
    return RedirectResponse("/", 303)
