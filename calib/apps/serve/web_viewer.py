"""The 3-D view of a session's recording: Rerun's web viewer, which accepts connections from this computer only."""

import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import ExitStack, suppress
from pathlib import Path
from urllib.parse import quote

from calib.errors import CalibError, require

# who asks from this computer
LOCAL = ("127.0.0.1", "::1")
ADDRESS = LOCAL[0]
# [s] that the viewer may take to answer (our choice)
START_TIME = 20.0


class WebViewer:
    """The viewer's process; it is started at the first request, and restarted when the recording is replaced."""

    def __init__(self) -> None:
        self.process: subprocess.Popen[bytes] | None = None
        self.address = ""
        # the recording that it shows, and when that was written
        self.version = (Path(), 0)

    def address_of(self, recording: Path) -> str:
        """Return the web address at which the viewer shows a recording.

        Raises:
            CalibError: Rerun does not start.
        """
        version = recording, recording.stat().st_mtime_ns
        if self.process is None or self.process.poll() is not None or self.version != version:
            self.close()
            pages, data = _free_ports(2)
            ports = ["--bind", ADDRESS, "--web-viewer-port", str(pages), "--port", str(data)]
            command = [sys.executable, "-m", "rerun", "--serve-web", *ports, str(recording)]
            quiet = subprocess.DEVNULL
            self.process = subprocess.Popen(command, stdout=quiet, stderr=quiet, start_new_session=True)
            require(_answers(pages), f"Rerun's viewer does not start; try: calib view {recording.parent}", CalibError)
            source = quote(f"rerun+http://{ADDRESS}:{data}/proxy", safe="")
            self.address = f"http://{ADDRESS}:{pages}/?url={source}"
            self.version = version
        return self.address

    def close(self) -> None:
        """Stop the viewer's process."""
        if self.process is not None:
            with suppress(ProcessLookupError):
                # Rerun's command starts its viewer as a process of its own
                if sys.platform == "win32":
                    self.process.kill()
                else:
                    os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()


def _free_ports(count: int) -> list[int]:
    with ExitStack() as stack:
        ports = []
        # All stay open until each has its port, so that no two are the same.
        for _ in range(count):
            server = stack.enter_context(socket.create_server((ADDRESS, 0)))
            ports.append(server.getsockname()[1])
        return ports


def _answers(port: int) -> bool:
    end = time.monotonic() + START_TIME
    while time.monotonic() < end:
        with suppress(OSError), socket.create_connection((ADDRESS, port), 1.0):
            return True
        time.sleep(0.1)
    return False
