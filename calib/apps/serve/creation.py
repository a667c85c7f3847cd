"""Page that makes a session where `calib serve` was given a new folder: the questions of `calib new`."""

import tempfile
from pathlib import Path

from starlette.concurrency import run_in_threadpool
from starlette.datastructures import UploadFile
from starlette.requests import Request
from starlette.responses import Response

from calib.apps.serve.page_responses import back, page_of
from calib.errors import CalibError, UsageError, complaint, require
from calib.toolkit.chains import controllers, robot_names
from calib.toolkit.sessions import (
    INSTRUMENTS,
    QUESTIONS,
    Answers,
    CertificateSection,
    Question,
    checked_answers,
    new_session,
    with_answer,
)

# files that a form may bring: question -> endings. Descriptions that name other files of this computer are refused
FILES = {"robot": (".urdf", ".toml"), "limits": (".toml",), "lens": (".yaml", ".yml"), "board": (".toml",)}
# end of the name of a form's field that brings a file
FILE = "_file"
# questions that have lists of answers
ALWAYS = ("robot", "instrument", "program", "dynamics", "tool", "tolerance_mm")
# bytes of a text and of the whole form, and number of files
MAX_TEXT, MAX_FORM, MAX_FILES = 1 << 16, 64 << 20, len(FILES)
COUNTS = {"poses": 40, "validation": 20, "seed": 0}


def creation_page(values: dict[str, str] | None = None, problem: str = "", had_files: bool = False) -> Response:
    """Return the page with the questions of `calib new`.

    Args:
        values: answers as they were sent; None: the defaults.
        problem: why they were refused; empty: nothing was refused.
        had_files: whether files came with them, which have to be chosen again.
    """
    choices = {"instrument": list(INSTRUMENTS), "program": ["none", *controllers()], "dynamics": ["yes", "no"]}
    first, further, certificate = [], [], []
    for question in QUESTIONS:
        if question.name in (*FILES, "details"):
            continue
        if question.name in ALWAYS:
            first.append(question)
        elif question.of is CertificateSection:
            certificate.append(question)
        elif question.of is Answers:
            further.append(question)
    status = 200
    if problem:
        status = 400
    return page_of(
        "new.html",
        status,
        robots=robot_names(),
        choices=choices,
        first=first,
        further=further,
        certificate=certificate,
        files=FILES,
        values=values or {},
        problem=problem,
        had_files=had_files,
    )


async def create(request: Request) -> Response:
    """Make the session that a form describes, or return the form with what is wrong."""
    folder: Path = request.app.state.work.folder
    length = request.headers.get("content-length", "")
    message = f"the form and its files are larger than {MAX_FORM >> 20} MB; nothing was made"
    require(length.isdecimal() and int(length) <= MAX_FORM, message, UsageError)
    values: dict[str, str] = {}
    uploaded: dict[str, Path] = {}
    with tempfile.TemporaryDirectory(prefix="calib-new-") as temporary:
        form = request.form(max_files=MAX_FILES, max_fields=200, max_part_size=MAX_TEXT)
        async with form as content:
            for field, value in content.multi_items():
                name = field.removesuffix(FILE)
                if not isinstance(value, UploadFile):
                    values[field] = value.strip()
                elif value.filename and name in FILES:
                    path = Path(temporary) / f"{name}{Path(value.filename).suffix.lower()}"
                    path.write_bytes(await value.read())
                    uploaded[name] = path
        try:
            await run_in_threadpool(_made, folder, values, uploaded)
        except (CalibError, OSError) as error:
            message = str(error)
            foreseen = complaint(error)
            if foreseen:
                message = foreseen[0]
            message = message.replace(f"{temporary}/", "the uploaded ")
            return creation_page(values, message, bool(uploaded))
    return back()


def _made(folder: Path, values: dict[str, str], uploaded: dict[str, Path]) -> None:
    """Make the session in a folder from the answers of a form.

    Args:
        folder: the folder, new or empty.
        values: texts by name of the question.
        uploaded: paths of uploaded files by name of the question.

    Raises:
        CalibError: an answer is not valid; the message says what is.
    """
    answers = Answers()
    for question in QUESTIONS:
        text = _text(question, values, uploaded)
        if text:
            answers = with_answer(answers, question, text)
    counts = {}
    for name, default in COUNTS.items():
        text = values.get(name, "")
        require(not text or text.isdecimal(), f"{name}: expected a whole number, found '{text}'", UsageError)
        counts[name] = int(text or default)
    holdout = values.get("holdout", "") or "0"
    try:
        share = float(holdout)
    except ValueError:
        raise UsageError(f"holdout: expected a share from 0 to 0.99, found '{holdout}'") from None
    links = {name: values.get(name, "") for name in ("base", "tip")}
    new_session(
        folder,
        plan=values.get("plan", "yes") == "yes",
        holdout=share,
        **counts,  # ty: ignore[invalid-argument-type]
        **links,
        **checked_answers(answers),
    )


def _text(question: Question, values: dict[str, str], uploaded: dict[str, Path]) -> str:
    """Return the answer to a question; empty if there is none.

    Paths are those of uploaded files only, so that no file of this computer is read.

    Args:
        question: the question.
        values: texts by name.
        uploaded: paths of uploaded files by name.

    Raises:
        UsageError: an uploaded file of another format.
    """
    name = question.name
    if name not in FILES:
        return values.get(name, "")
    if name in uploaded:
        endings = FILES[name]
        message = f"{name}: expected a file {' or '.join(endings)}; a xacro: xacro robot.urdf.xacro > robot.urdf"
        require(uploaded[name].suffix in endings, message, UsageError)
        return str(uploaded[name])
    if name == "robot":
        robot = values.get(name, "")
        require(not robot or robot in robot_names(), f"robot: '{robot}' is no robot of the library", UsageError)
        return robot
    return ""
