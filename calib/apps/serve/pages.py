"""The web pages of a served session: what to do now, files, steps, results."""

import atexit
import io
import re
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, HTMLResponse, PlainTextResponse, RedirectResponse, Response
from starlette.routing import Route

from calib.apps.joining.joining import METHODS
from calib.apps.serve import brought, creation, editing, received, split_logs
from calib.apps.serve.columns_wanted import Example, example_of
from calib.apps.serve.guard import Guard
from calib.apps.serve.page_responses import (
    MEASURED_KINDS,
    back,
    kind_of,
    kinds_of,
    name_of,
    page_of,
    refused,
    session_of,
)
from calib.apps.serve.web_viewer import LOCAL, WebViewer
from calib.apps.serve.work import NEXT, REDO, Work
from calib.apps.viewer.viewer import FILE as RECORDING
from calib.errors import CalibError
from calib.folders import FIGURES, PAGES
from calib.toolkit.chains import controllers
from calib.toolkit.pose_data import EULER
from calib.toolkit.report_pages import figures_page, read_figures, script_sources
from calib.toolkit.sessions import (
    BROUGHT,
    DONE,
    KEPT,
    SETTINGS,
    WAITING,
    Session,
    asks,
    chain_of,
    clear_staging,
    find_step,
    open_session,
    read_state,
    step_states,
)
from calib.units import ANGLES, LENGTHS

PICTURES = (".png", ".svg")
# of files, whoever wrote them; of scripts those of reports alone run
SANDBOX = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; script-src {}; sandbox allow-scripts"
# folders to take along as a whole: what they hold
BUNDLES = {"2-poses": "planned poses and their programs", "6-excitation": "motions to play"}
RESULTS = "the calibrated robot, for other programs"


def application(work: Work, token: str = "", host: str = "127.0.0.1") -> Starlette:
    """Return the web application of a session.

    Args:
        work: the session's worker.
        token: token required in every request; empty: none.
        host: host name accepted besides numeric addresses and this computer's names.
    """
    if (work.folder / SETTINGS).exists():
        clear_staging(open_session(work.folder))
    routes = [
        Route("/", page),
        Route("/page.js", script),
        Route("/files/{name:path}", file),
        Route("/figures/{name:path}", figures),
        Route("/view", view),
        Route("/next", go_on, methods=["POST"]),
        Route("/redo/{step}", go_on, methods=["POST"]),
        Route("/new", creation.create, methods=["POST"]),
        Route("/bring/{kind}", brought.bring, methods=["POST"]),
        Route("/columns/{kind}/{name}", brought.columns, methods=["POST"]),
        Route("/join/{kind}", brought.join, methods=["POST"]),
        Route("/take/{kind}", brought.take, methods=["POST"]),
        Route("/take/{kind}/{name}", brought.take_points, methods=["POST"]),
        Route("/aside/{name:path}", brought.set_aside, methods=["POST"]),
        Route("/example/{kind}", example),
        Route("/bundle/{name}.zip", bundle),
        Route("/settings", editing.settings_page),
        Route("/settings/{name}", editing.save, methods=["POST"]),
        Route("/options", editing.new_options, methods=["POST"]),
    ]
    guard = Middleware(Guard, token=token, host=host)  # type: ignore[arg-type]
    errors = {CalibError: refused, OSError: refused}
    app = Starlette(routes=routes, middleware=[guard], exception_handlers=errors)  # type: ignore[arg-type]
    app.state.work = work
    app.state.view = WebViewer()
    atexit.register(app.state.view.close)
    return app


def page(request: Request) -> Response:
    """Return the page with the current state of the session, or the questions of a new one."""
    work: Work = request.app.state.work
    if not (work.folder / SETTINGS).exists():
        return creation.creation_page()
    session = session_of(request)
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
    kinds = []
    for kind, description in kinds_of(session).items():
        kinds.append(_brought(session, kind, description))
    # what the page does itself is no command
    to_bring, _, _ = to_bring.partition("; then: ")
    tasks = [re.sub(r"^\d+ ", "", line) for line in task.splitlines()]
    file_names = [name_of(session, path) for path in _files(session)]
    pictures = [name for name in file_names if name.endswith(PICTURES)]
    return page_of(
        "page.html",
        session=session,
        states=states,
        ahead=ahead,
        work=work,
        to_bring=to_bring,
        tasks=tasks,
        verdicts=verdicts,
        kinds=kinds,
        joints=chain_of(session).joint_names,
        controllers=list(controllers()),
        eulers=EULER,
        units=(tuple(ANGLES), tuple(LENGTHS)),
        notes=_notes(session),
        pages=_pages(session),
        bundles=_bundles(session),
        recording=recording,
        figures=_figures(file_names),
        pictures=pictures,
        files=file_names,
    )


def _figures(file_names: Sequence[str]) -> dict[str, str]:
    """Return the addresses of pages with figures, by the file that has them.

    Args:
        file_names: names of the session's files.
    """
    addresses = {}
    for name in file_names:
        if name.endswith(f"/{FIGURES}"):
            addresses[name] = f"/figures/{name}"
        elif name.endswith(".html") and name not in PAGES and received.FOLDER not in name:
            addresses[name] = f"/files/{name}"
    return addresses


def figures(request: Request) -> Response:
    """Return the page with the figures of the session's file that the request's path names."""
    session = session_of(request)
    path = session.folder / request.path_params["name"]
    if path.name != FIGURES or path not in _files(session) or not _is_inside(session, path):
        return PlainTextResponse("no figures of this session", 404)
    headers = {"Content-Security-Policy": SANDBOX.format(script_sources()), "Cache-Control": "no-cache"}
    return HTMLResponse(figures_page(f"Figures of {path.parent.name}", [], read_figures(path)), headers=headers)


def _pages(session: Session) -> list[str]:
    return [name for name in PAGES if session.path(name).exists()]


def _notes(session: Session) -> dict[str, tuple[str, ...]]:
    return {name: record.notes for name, record in read_state(session).steps.items()}


@dataclass(frozen=True)
class Brought:
    """A kind of files on the page.

    Attributes:
        kind, description: its name, and what it is.
        names: paths of the files that the session reads.
        example: the columns that it wants.
        parts: received files that are no measurement yet.
        preview: joined files that can be taken; None if nothing is joined.
        planned: whether points alone can be taken with the planned joint values.
        answers: what was stated of the parts' columns: name of the part -> field of the form -> answer.
        halves: roles of two parts that are joined.
        methods: ways to join them.
        missing: what the other file of a recording must hold; empty if none is missing.
    """

    kind: str
    description: str
    names: tuple[str, ...]
    example: Example
    parts: tuple[received.Received, ...] = ()
    preview: received.Preview | None = None
    planned: bool = False
    answers: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    halves: tuple[str, str] = (received.JOINTS, received.POINTS)
    methods: tuple[str, ...] = METHODS
    missing: str = ""

    @property
    def folder(self) -> str:
        """Name of the session's folder in which they come."""
        return BROUGHT[self.kind][0]

    def of_role(self, role: str) -> list[str]:
        """Return the names of the received files that were recognised as `role`."""
        return [part.name for part in self.parts if part.role == role]


def _brought(session: Session, kind: str, description: str) -> Brought:
    """Return what the page shows of a kind of files (a key of `BROUGHT`)."""
    names = tuple(name_of(session, path) for path in session.brought(kind))
    example = example_of(session, kind)
    if kind not in MEASURED_KINDS:
        logs = split_logs.halves(session, kind)
        return Brought(
            kind,
            description,
            names,
            example,
            tuple(logs),
            received.preview(session, kind),
            halves=(split_logs.POSITIONS, split_logs.EFFORTS),
            methods=split_logs.METHODS,
            missing=split_logs.missing_half(session, logs),
        )
    parts = tuple(received.received(session, kind))
    planned = received.planned_poses(session, kind) is not None
    answers = received.stated_answers(session, kind)
    return Brought(kind, description, names, example, parts, received.preview(session, kind), planned, answers)


def _bundles(session: Session) -> dict[str, str]:
    """Return the folders that can be downloaded as a whole, with what each holds."""
    bundles = {**BUNDLES, session.export: RESULTS}
    return {name: content for name, content in bundles.items() if any(session.path(name).glob("*"))}


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
    session = session_of(request)
    path = session.folder / request.path_params["name"]
    if path not in _files(session) or not _is_inside(session, path):
        return PlainTextResponse("no such file in this session", 404)
    headers = {"X-Content-Type-Options": "nosniff", "Cache-Control": "no-cache"}
    # Viewers of PDF are scripts, which a sandbox would stop; what was received may be of anybody.
    if path.suffix != ".pdf" or received.FOLDER in path.parts:
        headers["Content-Security-Policy"] = SANDBOX.format(script_sources())
    return FileResponse(path, headers=headers)


def _is_inside(session: Session, path: Path) -> bool:
    """Return whether a path is in the session's folder, links followed."""
    return path.resolve().is_relative_to(session.folder.resolve())


def example(request: Request) -> Response:
    """Return an example of a kind of files as a CSV file."""
    session = session_of(request)
    kind = kind_of(request, session)
    headers = {"Content-Disposition": f'attachment; filename="example_{kind}.csv"'}
    return PlainTextResponse(example_of(session, kind).text, headers=headers, media_type="text/csv")


def bundle(request: Request) -> Response:
    """Return a folder of the session as a ZIP archive."""
    session = session_of(request)
    name = request.path_params["name"]
    if name not in _bundles(session):
        return PlainTextResponse("no such folder in this session", 404)
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as content:
        for path in _files(session):
            if path.is_relative_to(session.path(name)) and _is_inside(session, path):
                content.write(path, name_of(session, path))
    headers = {"Content-Disposition": f'attachment; filename="{session.folder.resolve().name}_{name}.zip"'}
    return Response(archive.getvalue(), headers=headers, media_type="application/zip")


def view(request: Request) -> Response:
    """Redirect to the 3-D view of the session's recording.

    This works only for browsers on this computer, since Rerun's server listens only there.
    """
    recording = session_of(request).path(RECORDING)
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
    return back()
