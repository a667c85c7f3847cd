"""Upload of files: streamed to the session's folder, under names that the session reads, and never stored in part."""

import os
import tempfile
from collections.abc import AsyncIterator
from pathlib import Path

from python_multipart import create_form_parser
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import File

from calib import files
from calib.apps.serve.received import FILES, place
from calib.errors import UsageError, require
from calib.toolkit.pose_data import IMAGES
from calib.toolkit.sessions import BROUGHT, LOGS, Session

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
# in the folder that is a ROS bag
BAG = "metadata.yaml"


def targets(session: Session, kind: str, names: list[str]) -> list[Path]:
    """Return the paths at which uploaded files of a kind (a key of `BROUGHT`) are stored, from the sender's file names.

    Raises:
        UsageError: names that are empty or equal, or that the session would not read as files of this kind.
    """
    folder, prefix = BROUGHT[kind]
    plain = []
    for name in names:
        last_part = name.replace("\\", "/").rpartition("/")[2]
        plain.append(last_part.lstrip("."))
    distinct = all(plain) and len(set(plain)) == len(plain)
    require(distinct, "two uploaded files have the same name, or one has no name: rename them", UsageError)

    subject = "log"
    is_measured = folder == "3-measured"
    if is_measured:
        subject = "measured"
    takes_images = is_measured and session.settings.instrument.measures == IMAGES
    if BAG in plain or takes_images:
        # these stay together in a folder of their own
        default = subject
        if prefix:
            default = f"{prefix}_{subject}"
        return [session.path(folder) / default / name for name in plain]

    other_prefixes = []
    for other_folder, other_prefix in BROUGHT.values():
        if other_folder == folder and other_prefix not in ("", prefix):
            other_prefixes.append(other_prefix)
    paths = []
    for name in plain:
        _check_suffix(session, name, is_measured)
        for start in other_prefixes:
            message = f"{name}: files named '{start}…' have another upload on this page; use that, or rename it"
            require(not name.lower().startswith(start), message, UsageError)
        if is_measured:
            # what it holds is found out before the session reads it
            paths.append(place(session, kind, FILES) / name)
            continue
        stored_name = name
        if not name.lower().startswith(prefix):
            stored_name = f"{prefix}_{name}"
        paths.append(session.path(folder) / stored_name)
    return paths


def _check_suffix(session: Session, name: str, is_measured: bool) -> None:
    """Raise UsageError for a file that a session cannot read, by the ending of its name.

    Args:
        session: the session.
        name: name of the file.
        is_measured: whether it comes as a measurement; otherwise as a recording. Measurements may be of any format, by
            whose content they are read.
    """
    ending = Path(name).suffix.lower()
    if not is_measured:
        message = f"{name}: expected {' or '.join(LOGS)}; nothing was stored"
        require(ending in LOGS, message, UsageError)
        return
    instrument = session.settings.instrument.name
    message = (
        f"{name}: is an image, and this session's instrument is a {instrument}: for images make a session with "
        "instrument = camera; nothing was stored"
    )
    require(ending not in PICTURES, message, UsageError)


async def receive(session: Session, kind: str, content_type: str, chunks: AsyncIterator[bytes]) -> list[Path]:
    """Store the files of an uploaded form, and return their paths.

    The files are first written to a temporary folder within the session's folder, and moved once all have arrived.

    Args:
        session: the session.
        kind: kind of the files, a key of `BROUGHT`.
        content_type: the request's header with the form's boundary.
        chunks: the request's body.

    Raises:
        UsageError: an incomplete form, or file names that `targets` refuses; nothing is stored.
    """
    prefix, suffix = files.staged_name(Path("upload"))
    with tempfile.TemporaryDirectory(suffix, prefix, session.folder) as staging:
        arrived: list[File] = []
        config = {"UPLOAD_DIR": staging, "UPLOAD_DELETE_TMP": False, "MAX_MEMORY_FILE_SIZE": 0}
        try:
            parser = create_form_parser({"Content-Type": content_type.encode()}, None, arrived.append, config=config)
            async for chunk in chunks:
                parser.write(chunk)
            parser.finalize()
        except (FormParserError, ValueError) as error:
            raise UsageError(f"the upload is not a form with files ({error}); nothing was stored") from error
        finally:
            for upload in arrived:
                upload.close()
        uploaded = [upload for upload in arrived if upload.file_name]
        require(uploaded, "no file was chosen", UsageError)
        names = []
        for upload in uploaded:
            file_name = upload.file_name or b""
            name = file_name.decode(errors="replace")
            message = f"{name} is empty (0 bytes): was it still being written? Nothing was stored"
            require(upload.size, message, UsageError)
            names.append(name)
        paths = targets(session, kind, names)
        for upload, path in zip(uploaded, paths):
            path.parent.mkdir(parents=True, exist_ok=True)
            staged = Path(os.fsdecode(upload.actual_file_name or b""))
            staged.chmod(0o666 & ~files.umask())
            os.replace(staged, path)
    return paths
