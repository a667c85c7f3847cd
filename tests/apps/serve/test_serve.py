"""The page of a session: who may ask, what is stored, one run at a time. In a browser: two tabs, a reload, a kill."""

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from html import unescape
from pathlib import Path
from typing import Any

import pytest
from sessions import begin, go_on
from starlette.testclient import TestClient

from calib.apps.cell_demo import demo
from calib.apps.serve import pages
from calib.apps.serve.pages import application
from calib.apps.serve.work import CHECK, NEXT, Work
from calib.procedure.session import commands, steps
from calib.procedure.session.folder import Session, open_session
from calib.simulation.virtual_cells import virtual_cell


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session that has not begun."""
    return begin(tmp_path_factory.mktemp("made") / "cell", "lwr4plus", "cmm", 12, 4, dynamics=False).folder


@pytest.fixture
def session(made: Path, tmp_path: Path) -> Session:
    shutil.copytree(made, tmp_path / "cell")
    return open_session(tmp_path / "cell")


class Recorded(Work):
    """A worker that only notes what it is asked."""

    def _begin(self) -> None:
        self.current = self._waiting.popleft()


@pytest.fixture
def client(session: Session) -> TestClient:
    return TestClient(application(Recorded(session.folder)), base_url="http://127.0.0.1:8000")


HEADER = ",".join([*(f"joint{k}" for k in range(1, 8)), "x,y,z,qx,qy,qz,qw"])
MEASURED = f"{HEADER}\n0,0,0,0,0,0,0,1,1,1,0,0,0,1\n1,0,0,0,0,0,0,1,1,1,0,0,0,1\n"


def bring(client: TestClient, kind: str, name: str, content: bytes = MEASURED.encode()) -> Any:
    return client.post(f"/bring/{kind}", files={"file": (name, content)}, follow_redirects=False)


def test_the_page_says_what_calib_next_says(session: Session, client: TestClient, monkeypatch) -> None:
    assert "read the robot" in client.get("/").text
    waits = steps.State(steps.find(session, "measure"), steps.WAITING, "a file of measured poses")
    monkeypatch.setattr(pages, "step_states", lambda _: [waits])
    task, file = commands.asks(session, waits)
    shown = re.sub("<.*?>", "", unescape(client.get("/").text))
    file, _, command = file.partition("; then: ")
    assert command not in shown, "the page does it"
    lines = [line.partition(" ")[2] for line in task.splitlines()]
    assert len(lines) == 3 and all(line in shown for line in (*lines, file))


def test_files_get_the_sessions_names(session: Session, client: TestClient) -> None:
    """Files come under the names that the session reads."""
    assert bring(client, "measured", "../../Shots 1.csv").status_code == 303
    assert bring(client, "validation", "later.csv").status_code == 303
    names = {kind: [path.name for path in session.brought(kind)] for kind in ("measured", "validation")}
    assert names == {"measured": ["Shots 1.csv"], "validation": ["validation_later.csv"]}
    assert client.app.state.work.current.task == CHECK  # type: ignore[attr-defined]
    for name, words in (("validation.csv", "have another upload"), ("shot.png", "is an image, and this session")):
        refused = bring(client, "measured", name)
        assert refused.status_code == 400 and words in refused.text
    assert bring(client, "training", "log.csv").status_code == 404, "the session has no dynamics"
    client.post("/aside/3-measured/Shots 1.csv")
    assert not session.brought("measured") and session.path("3-measured/aside/1_Shots 1.csv").exists()


def test_half_an_upload_leaves_no_file(session: Session, client: TestClient) -> None:
    head = b'--b\r\nContent-Disposition: form-data; name="file"; filename="m.csv"\r\n\r\nx\n'
    form = {"content-type": "multipart/form-data; boundary=b"}
    assert client.post("/bring/measured", content=head + b"1\n" * 9999, headers=form).status_code == 400
    assert not session.brought("measured") and not list(session.folder.rglob(".*"))


def test_two_presses_start_one_run(session: Session) -> None:
    work = Recorded(session.folder)
    assert work.ask(NEXT) and not work.ask(NEXT) and not work.ask("redo", "fit")
    assert work.ask(CHECK, "measured") and not work.ask(CHECK, "measured")


def test_who_may_ask(session: Session) -> None:
    served = application(Recorded(session.folder), token="secret", host="0.0.0.0")
    other = TestClient(served, base_url="http://192.168.1.7:8000")
    for asked in ("/", "/?token=wrong", "/files/session.toml"):
        refused = other.get(asked)
        assert refused.status_code == 403 and "token" in refused.text and "cell" not in refused.text
    assert other.post("/next?token=secret").status_code == 403
    assert other.get("/?token=secret").status_code == 200 and other.get("/files/session.toml").status_code == 200
    assert other.get("/", headers={"host": "evil.example:8000"}).status_code == 403
    for headers in ({"origin": "http://evil.example"}, {"origin": "null"}, {"sec-fetch-site": "cross-site"}):
        refused = other.post("/next", headers=headers)
        assert refused.status_code == 403 and "nothing was changed" in refused.text
    assert served.state.work.current is None
    assert other.post("/next", headers={"origin": "http://192.168.1.7:8000"}).status_code == 200
    assert served.state.work.current.task == NEXT


def test_only_the_sessions_files_are_served(session: Session, client: TestClient, tmp_path: Path) -> None:
    (tmp_path / "secret.txt").write_text("mine")
    session.path("link.txt").symlink_to(tmp_path / "secret.txt")
    for name in ("../secret.txt", "%2e%2e/secret.txt", "link.txt", ".hidden", "/etc/passwd"):
        assert client.get(f"/files/{name}").status_code == 404
    assert "sandbox" in client.get("/files/session.toml").headers["content-security-policy"]


@pytest.fixture
def browser() -> Iterator[Any]:
    from selenium import webdriver

    programs = [shutil.which(name) for name in ("chromium", "chromedriver")]
    if None in programs:
        pytest.skip("chromium or chromedriver is not installed (Debian: apt-get install chromium chromium-driver)")
    options = webdriver.ChromeOptions()
    options.binary_location = str(programs[0])
    for word in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--window-size=820,1180"):
        options.add_argument(word)
    driver = webdriver.Chrome(options, webdriver.ChromeService(programs[1]))
    driver.implicitly_wait(10)
    yield driver
    driver.quit()


class Served:
    """A server of its own process."""

    def __init__(self, folder: Path) -> None:
        command = [sys.executable, "-u", "-m", "calib", "serve", str(folder), "--port", "0"]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        found = re.search(r"http://\S+", self.process.stdout.readline())
        assert found is not None
        self.address = found[0]


def until(holds: Any, seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.2)


def runs_or_ran(text: str) -> bool:
    """Return whether the first steps run, or are done: a slow browser may look too late to see them run."""
    return "Running" in text or "Measure the target" in text


@pytest.mark.slow
def test_in_a_browser_nothing_is_lost(session: Session, browser: Any) -> None:
    """Continue in two tabs, a reload in the middle, the server killed, then files uploaded up to the certificate."""
    served = Served(session.folder)

    def text(part: str = "now") -> str:
        return browser.execute_script(f"return document.getElementById('{part}').innerText")

    try:
        browser.get(served.address)
        browser.execute_script("window.open(arguments[0])", served.address)
        for tab in browser.window_handles:
            browser.switch_to.window(tab)
            until(lambda: "Running" in text() or browser.find_elements("css selector", "button.main"))
            # the page may exchange the button between being found and being clicked
            browser.execute_script("document.querySelector('button.main')?.click()")
        until(lambda: runs_or_ran(text()))
        browser.refresh()
        assert runs_or_ran(text())
        os.kill(served.process.pid, signal.SIGKILL)
        served = Served(session.folder)
        browser.get(served.address)
        browser.find_element("css selector", "button.main").click()
        until(lambda: "Measure the target" in text())

        twin = session.folder.with_name("twin")
        shutil.copytree(session.folder, twin)
        demo.simulate_measurements(open_session(twin), virtual_cell("lwr4plus"), 0)
        large = twin / "3-measured/measured.csv"
        large.write_text(large.read_text() + "# filling\n" * 2_000_000)
        for kind, path in (("measured", large), ("validation", twin / "3-measured/validation_measured.csv")):
            form = browser.find_element("css selector", f"form[action='/bring/{kind}']")
            form.find_element("css selector", "input").send_keys(str(path))
            form.find_element("css selector", "button").click()
            until(lambda kind=kind: "rows of kind" in text(f"brought-{kind}"))
        assert session.path("3-measured/measured.csv").read_bytes() == large.read_bytes()
        until(lambda: browser.find_elements("css selector", "button.main"))
        browser.find_element("css selector", "button.main").click()
        until(lambda: "certificate.html" in text() and "Complete" in text())
        assert go_on(open_session(session.folder)) is None
    finally:
        served.process.send_signal(signal.SIGINT)
        served.process.wait(20)


def test_the_view_is_of_this_computer_only(session: Session, client: TestClient) -> None:
    """Rerun's viewer and its data listen here alone; another computer is told so, and a session without a recording."""
    rerun = pytest.importorskip("rerun")
    assert client.get("/view").status_code == 404
    with rerun.RecordingStream("calib") as stream:
        stream.save(str(session.path("session.rrd")))
        stream.log("point", rerun.Points3D([[0.0, 0.0, 0.0]]))
    assert client.get("/view").status_code == 403  # of a client named otherwise
    app = client.app
    with TestClient(app, base_url="http://127.0.0.1:8000", client=("127.0.0.1", 50000)) as here:
        places = [here.get("/view", follow_redirects=False).headers["location"] for _ in range(2)]
    try:
        assert places[0] == places[1] and places[0].startswith("http://127.0.0.1:")
        with urllib.request.urlopen(places[0], timeout=10) as answer:
            assert answer.status == 200 and b"rerun" in answer.read().lower()
        port = int(places[0].split(":")[2].split("/")[0])
        with pytest.raises(OSError), socket.create_connection((other_address(), port), 2.0):
            pass
    finally:
        app.state.view.close()
    with pytest.raises(OSError):
        for _ in range(50):  # the killed viewer takes a moment to go
            socket.create_connection(("127.0.0.1", port), 2.0).close()
            time.sleep(0.1)


def other_address() -> str:
    """Return an address of this computer by which others reach it, or else one of the loopback's others."""
    found = {str(each[4][0]) for each in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)}
    return next((each for each in found if not each.startswith("127.")), "127.0.0.2")
