"""Page on which the settings of a served session, and the files that they name, are edited as text."""

import os
from pathlib import Path

from starlette.requests import Request
from starlette.responses import Response

from calib import files
from calib.apps.serve.brought import form_of
from calib.apps.serve.page_responses import back, page_of, session_of
from calib.errors import CalibError, UsageError, require
from calib.toolkit.chains import toml_table
from calib.toolkit.pose_data import read_fit_options
from calib.toolkit.sessions import SETTINGS, Session, read_settings

# name of a file of options that is made here
OPTIONS = "options.toml"
HELP = {
    SETTINGS: "what is calibrated, with what, and how; steps that depend on a changed value are repeated",
    "fit": "how measured files are read (columns, units, angles), and the fit: calib formats options",
    "constraints": "limits of the poses: calib formats constraints",
    "limits": "limits of poses and motions: calib formats limits",
    "dynamics": "the identification: calib formats identify-options",
}
NEW_OPTIONS = """# How measured files are read, where their headers do not say it. All keys: calib formats options
# euler = "xyz fixed"
# [columns]
# x = "X_leica"
# [units]
# joints = "deg"
"""


def editable(session: Session) -> dict[str, str]:
    """Return the names of the files of settings that can be edited, each with what it is for."""
    settings = session.settings
    names = {SETTINGS: HELP[SETTINGS]}
    purposes = {
        settings.fit.options: "fit",
        settings.poses.constraints: "constraints",
        settings.dynamics.limits: "limits",
        settings.dynamics.options: "dynamics",
    }
    for name, purpose in purposes.items():
        if name and session.path(name).is_file():
            names[name] = HELP[purpose]
    return names


def settings_page(request: Request) -> Response:
    """Return the page with the files of settings."""
    return _page(session_of(request))


def _page(session: Session, edited: str = "", text: str = "", problem: str = "") -> Response:
    """Return the page of settings.

    Args:
        session: the session.
        edited: name of the file whose change was refused; empty: none.
        text: its text as it was sent.
        problem: why it was refused.
    """
    texts = {}
    for name, purpose in editable(session).items():
        content = text
        if name != edited:
            content = session.path(name).read_text(encoding="utf-8")
        texts[name] = (purpose, content)
    offers = not session.settings.fit.options and session.geometric
    status = 400 if problem else 200
    return page_of("settings.html", status, session=session, texts=texts, edited=edited, problem=problem, offers=offers)


async def save(request: Request) -> Response:
    """Store an edited file of settings after its check, or return the page with what is wrong."""
    session = session_of(request)
    name = request.path_params["name"]
    require(name in editable(session), f"{name}: no file of settings of this session", UsageError)
    answers = await form_of(request)
    text = answers.get("text", "").replace("\r\n", "\n") + "\n"
    path = session.path(name)
    # beside the file, since it may name other files
    prefix, suffix = files.staged_name(path)
    staged = path.with_name(f"{prefix}edited{suffix}")
    try:
        files.write(staged, text)
        _check(session, name, staged)
        os.replace(staged, path)
    except CalibError as error:
        return _page(session, name, text, str(error).replace(str(staged), name))
    finally:
        staged.unlink(missing_ok=True)
    return back()


def _check(session: Session, name: str, path: Path) -> None:
    """Raise CalibError if a text is no valid file of settings; files of limits are checked by their step.

    Args:
        session: the session.
        name: name of the file that it is to replace.
        path: the file with the text.
    """
    if name == SETTINGS:
        read_settings(path)
    elif name == session.settings.fit.options:
        read_fit_options(path)
    else:
        toml_table(path)


def new_options(request: Request) -> Response:
    """Make a file of options for measured files, which the settings name."""
    session = session_of(request)
    require(not session.settings.fit.options, "the session has a file of options already", UsageError)
    settings = session.path(SETTINGS)
    text = settings.read_text(encoding="utf-8")
    head, section, tail = text.partition("[fit]")
    changed = tail.replace('options = ""', f'options = "{OPTIONS}"', 1)
    require(section and changed != tail, f'write options = "{OPTIONS}" into [fit] of {SETTINGS}', UsageError)
    if not session.path(OPTIONS).exists():
        files.write(session.path(OPTIONS), NEW_OPTIONS)
    files.write(settings, head + section + changed)
    return back_to_settings()


def back_to_settings() -> Response:
    """Return a redirection to the page of settings."""
    response = back()
    response.headers["location"] = "/settings"
    return response
