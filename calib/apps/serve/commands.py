"""Command that serves a session as a web page: serve."""

from pathlib import Path
from typing import Annotated

import typer

from calib.cli.shared import command, say
from calib.errors import UsageError, refused_as
from calib.workers.extras import needing

app = typer.Typer()
LOCAL = "127.0.0.1"


@command(app, "Start")
def serve(folder: Path, host: str = LOCAL, port: Annotated[int, typer.Option(min=0)] = 8000) -> None:
    """Serve a session as a web page: what to do now, upload of files with their check, progress, results.

    A new or empty folder becomes a session on the page. Joint values and points that are uploaded apart are joined
    there. It stops with Ctrl-C; the session goes on from there.

    Example: calib serve cell

    Args:
        folder: of the session; a new one is made on the page
        host: address to listen on. For a tablet 0.0.0.0: whoever has the address with the token that is then printed
            may read and change this session; the connection is not encrypted
        port: 0 for any that is free
    """
    import secrets
    import socket

    from calib.toolkit.sessions import open_session

    with needing("starlette"):
        import uvicorn

        from calib.apps.serve.pages import application
    from calib.apps.serve.work import Work

    is_new = not folder.exists() or (folder.is_dir() and not any(folder.iterdir()))
    if not is_new:
        open_session(folder)
    token = query = ""
    if host not in (LOCAL, "localhost"):
        token = secrets.token_urlsafe(16)
        query = f"?token={token}"
    message = f"cannot listen on {host}, port {port} ({{}}); try another --port"
    with refused_as(UsageError, (OSError, OverflowError), message):
        listening = socket.create_server((host, port))
    work = Work(folder)
    reached_by = host
    if host == "0.0.0.0":
        reached_by = _own_address()
    address = f"http://{reached_by}:{listening.getsockname()[1]}/{query}"
    say(f"{folder}: {address} (Ctrl-C stops)", result=True)
    try:
        config = uvicorn.Config(application(work, token, host), log_level="warning", server_header=False)
        uvicorn.Server(config).run(sockets=[listening])
    except KeyboardInterrupt:
        # uvicorn hands it on once it has stopped
        pass
    finally:
        work.stop()


def _own_address() -> str:
    """Return this computer's IP address in the local network, or its host name if it has no such address.

    The address is that of the interface that would route to another network; nothing is sent.
    """
    import socket

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as route:
        try:
            # an address of documentation (RFC 5737)
            route.connect(("192.0.2.1", 9))
            return route.getsockname()[0]
        except OSError:
            return socket.gethostname()
