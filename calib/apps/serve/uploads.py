"""Files brought over the network: streamed to the session's folder, under names that it knows, whole or not at all."""

import os
import tempfile
from collections.abc import AsyncIterator
from pathlib import Path

from python_multipart import create_form_parser
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import File

from calib import files
from calib.errors import UsageError, require
from calib.toolkit.pose_data import IMAGES
from calib.toolkit.sessions import BROUGHT, LOGS, Session

BAG = "metadata.yaml"  # of a ROS bag, which is a folder


def targets(session: Session, kind: str, names: list[str]) -> list[Path]:
    """Return where files of a kind (`BROUGHT`) belong, by the names that they have on the sender's side.

    Raises:
        UsageError: for names by which the session would take them for something else, or nothing.
    """
    folder, prefix = BROUGHT[kind]
    plain = [name.replace("\\", "/").rpartition("/")[2].lstrip(".") for name in names]
    distinct = all(plain) and len(set(plain)) == len(plain)
    require(distinct, "two files of one name, or one without: rename them", UsageError)
    default = "_".join(filter(None, (prefix, "measured" if folder == "3-measured" else "log")))
    if BAG in plain or (folder == "3-measured" and session.settings.instrument.measures == IMAGES):
        return [session.path(folder) / default / name for name in plain]
    other_prefixes = tuple(start for where, start in BROUGHT.values() if where == folder and start not in ("", prefix))
    for name in plain:
        suffixes = LOGS if folder == "7-recorded" else (".csv",)
        message = f"{name}: expected {' or '.join(suffixes)}; nothing was stored"
        require(name.lower().endswith(suffixes), message, UsageError)
        for start in other_prefixes:
            message = f"{name}: a name that begins with '{start}' says other files; upload it there, or rename it"
            require(not name.lower().startswith(start), message, UsageError)
    stored_names = [name if name.lower().startswith(prefix) else f"{prefix}_{name}" for name in plain]
    return [session.path(folder) / name for name in stored_names]


async def receive(session: Session, kind: str, content_type: str, chunks: AsyncIterator[bytes]) -> list[Path]:
    """Store the files of a form as it arrives, and return their paths.

    They are written beside the session's files, and put into place once all have arrived.

    Raises:
        UsageError: for an incomplete form, and what `targets` refuses; nothing is stored.
    """
    prefix, suffix = files.staged_name(Path("upload"))
    with tempfile.TemporaryDirectory(suffix, prefix, session.folder) as staging:
        arrived, ended = list[File](), list[bool]()
        config = {"UPLOAD_DIR": staging, "UPLOAD_DELETE_TMP": False, "MAX_MEMORY_FILE_SIZE": 0}
        try:
            parser = create_form_parser({"Content-Type": content_type.encode()}, None, arrived.append, config=config)
            parser.on_end = lambda: ended.append(True)
            async for chunk in chunks:
                parser.write(chunk)
            parser.finalize()
        except (FormParserError, ValueError) as error:
            raise UsageError(f"the upload is not a form with files ({error}); nothing was stored") from error
        finally:
            for upload in arrived:
                upload.close()
        uploaded = [upload for upload in arrived if upload.size]
        require(uploaded, "no file was chosen, or it is empty", UsageError)
        names = [(upload.file_name or b"").decode(errors="replace") for upload in uploaded]
        places = targets(session, kind, names)
        for upload, target in zip(uploaded, places):
            target.parent.mkdir(exist_ok=True)
            written = Path(os.fsdecode(upload.actual_file_name or b""))
            written.chmod(0o666 & ~files.umask())
            os.replace(written, target)
    return places
