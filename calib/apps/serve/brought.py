"""Requests that bring files to a served session, state their columns, join them, and take them as a measurement."""

from collections.abc import Callable
from pathlib import Path

from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect, Request
from starlette.responses import PlainTextResponse, Response

from calib.apps.serve import received, split_logs, uploads
from calib.apps.serve.page_responses import MEASURED_KINDS, back, kind_of, kinds_of, name_of, session_of
from calib.apps.serve.received import JOINTS, POINTS, Pairing
from calib.apps.serve.work import CHECK, JOIN, Work
from calib.errors import UsageError, require
from calib.toolkit.sessions import Session

# bytes of a form without files
MAX_FORM = 1 << 20


async def bring(request: Request) -> Response:
    """Store the files of an uploaded form, and queue their check, or the join of two that belong together."""
    session = session_of(request)
    kind = request.path_params["kind"]
    if kind not in kinds_of(session):
        return PlainTextResponse("this session does not accept such files", 404)
    try:
        paths = await uploads.receive(session, kind, request.headers.get("content-type", ""), request.stream())
    except ClientDisconnect:
        return PlainTextResponse("interrupted; nothing was stored", 400)
    work: Work = request.app.state.work
    if kind in MEASURED_KINDS:
        received.discard_joined(session, kind)
        await run_in_threadpool(_sort, work, session, kind)
    else:
        await run_in_threadpool(_sort_logs, work, session, kind, paths)
    return back(f"brought-{kind}")


def _sort_logs(work: Work, session: Session, kind: str, paths: list[Path]) -> None:
    """Queue the check of uploaded logs, or the join of two that each hold half of a recording.

    Args:
        work: the session's worker.
        session: the session.
        kind: kind of the logs.
        paths: the uploaded logs.
    """
    recordings = split_logs.put_halves_apart(session, kind, paths)
    if recordings:
        work.ask(CHECK, kind)
    if len(recordings) == len(paths):
        return
    received.discard_joined(session, kind)
    work.joins.pop(kind, None)
    pairing = split_logs.pairing_of(split_logs.halves(session, kind))
    if pairing is not None:
        work.ask(JOIN, kind, pairing)


def _sort(work: Work, session: Session, kind: str) -> None:
    """Take what is a whole measurement, and queue its check, or the join of joint values with points.

    Args:
        work: the session's worker.
        session: the session.
        kind: kind of the files.
    """
    if received.take_measured(session, kind) or not received.waiting(session, kind):
        work.ask(CHECK, kind)
    parts = received.received(session, kind)
    joints = [part.name for part in parts if part.role == JOINTS]
    points = [part.name for part in parts if part.role == POINTS]
    if len(joints) == len(points) == 1 and received.preview(session, kind) is None:
        work.ask(JOIN, kind, Pairing(joints[0], points[0]))


async def columns(request: Request) -> Response:
    """Store what a form says of a received file's columns, and sort the file again."""
    session = session_of(request)
    kind = kind_of(request, session)
    name = request.path_params["name"]
    answers = await form_of(request)
    names = [path.name for path in received.waiting(session, kind)]
    require(name in names, f"{name}: no such file waits for its columns", UsageError)
    await run_in_threadpool(received.state_columns, session, kind, name, answers)
    await run_in_threadpool(_sort, request.app.state.work, session, kind)
    return back(f"brought-{kind}")


async def join(request: Request) -> Response:
    """Queue the join of the received files that a form names."""
    session = session_of(request)
    kind = kind_of(request, session)
    answers = await form_of(request)
    pairing = Pairing(answers.get("joints", ""), answers.get("points", ""), answers.get("by", ""))
    received.discard_joined(session, kind)
    request.app.state.work.ask(JOIN, kind, pairing)
    return back(f"brought-{kind}")


async def form_of(request: Request) -> dict[str, str]:
    """Return the texts of a form without files, by name.

    Raises:
        UsageError: a form that is too long, or with files.
    """
    length = request.headers.get("content-length", "")
    require(length.isdecimal() and int(length) <= MAX_FORM, "the form is too long; nothing was stored", UsageError)
    answers = {}
    async with request.form(max_files=0, max_fields=500) as form:
        for name, value in form.items():
            answers[name] = str(value).strip()
    return answers


def take(request: Request) -> Response:
    """Make the joined table the measurement or the recording of its step, and queue its check."""
    if request.path_params["kind"] not in MEASURED_KINDS:
        return _take(request, split_logs.take_recording)
    return _take(request, received.take_joined)


def take_points(request: Request) -> Response:
    """Make points the measurement of their step, with the planned joint values, and queue the check."""
    name = request.path_params["name"]
    return _take(request, lambda session, kind: received.take_points(session, kind, name))


def _take(request: Request, make: Callable[[Session, str], object]) -> Response:
    session = session_of(request)
    kind = kind_of(request, session)
    make(session, kind)
    work: Work = request.app.state.work
    work.joins.pop(kind, None)
    work.ask(CHECK, kind)
    return back(f"brought-{kind}")


def set_aside(request: Request) -> Response:
    """Move the uploaded file of the request into a folder ``aside``, where the session does not read it."""
    work: Work = request.app.state.work
    name = request.path_params["name"]
    session = session_of(request)
    for kind in kinds_of(session):
        paths = [*session.brought(kind), *received.waiting(session, kind)]
        for path in paths:
            if name_of(session, path) != name:
                continue
            aside = path.parent / "aside"
            aside.mkdir(exist_ok=True)
            path.replace(aside / f"{len(list(aside.iterdir())) + 1}_{path.name}")
            if path.parent.name == received.FILES:
                received.discard_joined(session, kind)
                work.joins.pop(kind, None)
            else:
                work.ask(CHECK, kind)
            return back(f"brought-{kind}")
    return back()
