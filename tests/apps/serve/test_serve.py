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
from dataclasses import replace
from html import unescape
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pytest
from browsers import chromium
from sessions import begin, go_on
from starlette.testclient import TestClient

from calib.apps.cell_demo import demo
from calib.apps.serve import pages, received, split_logs
from calib.apps.serve.pages import application
from calib.apps.serve.work import CHECK, NEXT, Work
from calib.data.recordings.recording_files import read_recording
from calib.errors import MeasurementError, UsageError
from calib.procedure.report.figures import figure_data
from calib.procedure.report.figures.charts import Chart, Line, Panel
from calib.procedure.session import commands, steps
from calib.procedure.session.folder import Session, open_session
from calib.procedure.session.geometry_steps import chain_of, read_measured
from calib.procedure.session.questions import stated_payloads
from calib.robot.chain import random_joints
from calib.robot.kinematics import forward
from calib.simulation.virtual_cells import virtual_cell
from calib.toolkit.result_folders import joints_of
from calib.transforms import pose


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


# width of a telephone held upright [pixels]
NARROW = 400
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


def points_and_joints(session: Session, count: int = 16) -> tuple[bytes, bytes, np.ndarray]:
    """Return points of a tracker as a text export, in another order, a controller's joints, and the joints [rad]."""
    chain = chain_of(session)
    q = 0.5 * random_joints(chain, count, 5)
    tips = forward(chain, q) @ pose(None, [0.06, -0.04, 0.1])
    order = np.random.default_rng(1).permutation(count)
    points = ["// SpatialAnalyzer 2024.1", "// Units: mm"]
    points += [f"T::C::P{k + 1:02d}; " + "; ".join(f"{x:.4f}" for x in 1e3 * tips[k, :3, 3]) for k in order]
    joints = ["Punkt;" + ";".join("stuvwkl")]
    joints += [f"P{k + 1};" + ";".join(f"{x:.5f}" for x in np.degrees(q[k])) for k in range(count)]
    return "\n".join(points).encode("utf-16"), "\n".join(joints).encode(), q


@pytest.mark.slow
def test_joints_and_points_apart_are_joined_in_the_page(session: Session, client: TestClient) -> None:
    """Columns are asked for, the pairing is shown, and taken as the measurement of the step."""
    points, joints, q = points_and_joints(session)
    work = client.app.state.work  # type: ignore[attr-defined]
    assert bring(client, "measured", "points.txt", points).status_code == 303
    assert "The joint values that belong to these points are missing" in client.get("/").text
    assert bring(client, "measured", "../joints.dat.csv", joints).status_code == 303
    assert not session.brought("measured") and not work.joins

    answers = {f"columns.q{k}": name for k, name in enumerate("stuvwkl", 1)} | {"units.joints": "deg", "columns.x": ""}
    page = "/columns/measured/joints.dat.csv"
    refused = client.post(page, data=answers | {"units.joints": "furlong"})
    assert refused.status_code == 400 and "furlong" in refused.text and "deg" in refused.text
    assert client.post(page, data=answers).status_code == 200
    asked = work.current.pairing
    assert (asked.joints, asked.points) == ("joints.dat.csv", "points.txt")
    notes = received.join_received(session, "measured", asked)
    shown = unescape(client.get("/").text)
    assert all(note in shown for note in notes[:-1])
    assert "joined by name" in shown and "s, t, u, v, w, k, l read as q1" in shown

    assert client.post("/take/measured").status_code == 200
    (path,) = session.brought("measured")
    ((_, block),) = read_measured(session, chain_of(session), [path])
    np.testing.assert_allclose(block.q, q, atol=1e-6)
    assert client.post("/take/measured").status_code == 400, "taken already"
    assert len(list(session.path("3-measured/received/measured/used").iterdir())) == 2


def halves_of_a_log() -> tuple[bytes, bytes]:
    """Return positions, and currents 2 ms later, of seven joints as CSV files, whose columns are named alike."""
    t = np.arange(200) / 100.0
    q = np.sin(t[:, None] * np.arange(1.0, 8.0))
    contents = []
    for late, values in ((0.0, q), (0.002, 1e3 * q)):
        lines = ["time," + ",".join(f"joint{k}" for k in range(1, 8))]
        lines += [",".join(f"{x:.6f}" for x in row) for row in np.column_stack([t + late, values])]
        contents.append("\n".join(lines).encode())
    return contents[0], contents[1]


@pytest.mark.slow
def test_two_logs_of_one_motion_are_joined_in_the_page(tmp_path: Path) -> None:
    """Half a recording waits for the other half; both are paired by time, shown, and taken under the awaited name."""
    payloads = stated_payloads(["load=3.28 at 0,0,0.05"])
    session = begin(tmp_path / "cell", "lwr4plus", "cmm", 12, 4, payloads=payloads)
    client = TestClient(application(Recorded(session.folder)), base_url="http://127.0.0.1:8000")
    work = client.app.state.work  # type: ignore[attr-defined]
    positions, currents = halves_of_a_log()
    assert bring(client, "training", "load_position.csv", positions).status_code == 303
    shown = unescape(client.get("/").text)
    assert "The torques or currents of this motion are missing" in shown and "tau_" in shown
    assert not session.brought("training") and work.current is None
    client.post("/aside/7-recorded/received/training/files/load_position.csv")
    assert not received.waiting(session, "training")

    assert bring(client, "training", "load_current_mA.csv", currents).status_code == 303
    assert "The positions of this motion are missing" in client.get("/").text
    assert bring(client, "training", "load_position.csv", positions).status_code == 303
    asked = work.current.pairing
    assert (asked.joints, asked.points) == ("load_position.csv", "load_current_mA.csv")
    notes = split_logs.join_halves(session, "training", asked)
    shown = unescape(client.get("/").text)
    assert all(note in shown for note in notes[:-1])
    assert "joined by time" in shown and "joint1 as current_joint1" in shown and "Take as the recording" in shown

    assert client.post("/take/training").status_code == 200
    (path,) = session.brought("training")
    assert path.name == "training_load_log.csv"
    recording = read_recording(path, joints_of(chain_of(session)))
    assert recording.kind == "current"
    # the first position is before the first current, and left out; currents are 2 ms late
    t = recording.t[:, None] + 0.01
    np.testing.assert_allclose(recording.q, np.sin(t * np.arange(1.0, 8.0)), atol=1e-5)
    np.testing.assert_allclose(recording.effort, np.sin((t - 0.002) * np.arange(1.0, 8.0)), atol=1e-3)
    assert client.post("/take/training").status_code == 400, "taken already"
    assert not received.waiting(session, "training")


def test_whole_logs_and_logs_of_other_clocks(tmp_path: Path) -> None:
    """A whole log is checked as it is, and waits for nothing; halves without common times stay, with the cause."""
    session = begin(tmp_path / "cell", "lwr4plus", "cmm", 12, 4)
    client = TestClient(application(Recorded(session.folder)), base_url="http://127.0.0.1:8000")
    work = client.app.state.work  # type: ignore[attr-defined]
    example = client.get("/example/training").content
    assert bring(client, "training", "run.csv", example).status_code == 303
    assert [path.name for path in session.brought("training")] == ["run.csv"] and work.current.task == CHECK

    positions, currents = halves_of_a_log()
    later = currents.replace(b"\n0.", b"\n9000.").replace(b"\n1.", b"\n9001.")
    files = [("file", ("position.csv", positions)), ("file", ("torque.csv", later))]
    assert client.post("/bring/unseen", files=files).status_code == 200
    assert not session.brought("unseen")
    pairing = split_logs.pairing_of(split_logs.halves(session, "unseen"))
    assert pairing is not None
    with pytest.raises(MeasurementError, match="of one clock"):
        split_logs.join_halves(session, "unseen", pairing)
    form = {"joints": pairing.joints, "points": pairing.points, "by": "row"}
    assert client.post("/join/unseen", data=form).status_code == 200
    split_logs.join_halves(session, "unseen", replace(pairing, by="row"))
    assert client.post("/take/unseen").status_code == 200
    assert [path.name for path in session.brought("unseen")] == ["validation_log.csv"]


@pytest.mark.parametrize(
    ("header", "stem", "half"),
    [
        (("t", "q1", "q2"), "log", split_logs.POSITIONS),
        (("t", "tau_a", "tau_b", "v_a", "v_b"), "log", split_logs.EFFORTS),
        (("t", "q1", "i1"), "torque", ""),
        (("t", "v1", "v2"), "log", ""),
        (("t", "a", "b"), "log", ""),
        (("t", "q1", "q2"), "current_mA", split_logs.EFFORTS),
    ],
)
def test_halves_are_told_by_columns_and_names(header: tuple[str, ...], stem: str, half: str) -> None:
    assert split_logs.half_of(header, stem) == half


@pytest.mark.slow
def test_mistakes_in_files_are_shown_with_their_cure(session: Session, client: TestClient) -> None:
    """What cannot be read is no measurement; the page says why, and what to do."""
    names = ",".join(f"joint{k}" for k in range(1, 8))
    for name, content, words in (
        ("book.xlsx", b"PK\x03\x04" + bytes(range(256)), "save the sheet as CSV"),
        ("far.csv", b"x,y,z\n1000,2,3\n1100,2,3\n", "[mm]"),
        ("deg.csv", f"{names}\n0,0,0,0,0,0,0\n90,0,0,0,0,0,0\n".encode(), "[deg]"),
        ("<i>.csv", b"u,v\n1,2\n", "say below which of them is what"),
    ):
        assert bring(client, "measured", name, content).status_code == 303
        (part,) = received.received(session, "measured")
        page = client.get("/").text
        assert part.role == "unclear" and words in part.message, part.message
        assert words in unescape(page) and "<i>" not in page
        client.post(f"/aside/3-measured/received/measured/files/{quote(name)}")
    assert not session.brought("measured") and not received.waiting(session, "measured")
    refused = bring(client, "measured", "none.csv", b"")
    assert refused.status_code == 400 and "none.csv is empty" in refused.text
    for kind, name in (("training", "x"), ("measured", "../../session.toml"), ("measured", "x")):
        assert client.post(f"/columns/{kind}/{quote(name, safe='')}", data={}).status_code in (400, 404)
    missing = client.post("/join/measured", data={"joints": "../../session.toml", "points": "/etc/passwd"})
    assert missing.status_code == 200
    with pytest.raises(UsageError, match="no such file was received"):
        received.join_received(session, "measured", client.app.state.work.current.pairing)  # type: ignore[attr-defined]


def test_the_page_says_which_columns_it_wants(session: Session, client: TestClient) -> None:
    """The example of a kind of files is a file that the session reads."""
    example = client.get("/example/measured")
    assert all(f"<th>{column}</th>" in client.get("/").text for column in example.text.splitlines()[0].split(","))
    session.path("2-poses/poses.csv").write_text(f"{HEADER.partition(',x')[0]}\n0.1,0,0,0,0,0,0\n0,0,0,0,0,0,0.2\n")
    example = client.get("/example/measured")
    assert bring(client, "measured", "m.csv", example.content).status_code == 303
    assert [path.name for path in session.brought("measured")] == ["m.csv"]
    assert client.get("/example/secret").status_code == 400


def test_settings_are_edited_in_the_page(session: Session, client: TestClient) -> None:
    """A mistake is shown with its cure, beside the text as it was typed, and nothing is stored."""
    settings = session.path("session.toml").read_text()
    changed = settings.replace("tolerance_mm = 0.0", "tolerance_mm = 0.25")
    wrong = client.post("/settings/session.toml", data={"text": changed.replace('loss = "auto"', 'loss = "robust"')})
    assert wrong.status_code == 400 and "cauchy" in wrong.text and "0.25" in wrong.text
    assert session.path("session.toml").read_text() == settings and not list(session.folder.glob(".*"))
    assert client.post("/settings/session.toml", data={"text": changed}).status_code == 200
    assert open_session(session.folder).settings.fit.tolerance_mm == 0.25
    assert client.post("/options").status_code == 200
    assert open_session(session.folder).settings.fit.options == "options.toml"
    assert client.post("/settings/options.toml", data={"text": 'euler = "no such"'}).status_code == 400
    for name in ("state.json", "..%2Fx", "1-robot%2Frobot.toml"):
        assert client.post(f"/settings/{name}", data={"text": "x"}).status_code in (400, 404)


def test_a_session_begins_in_the_page(tmp_path: Path) -> None:
    """A new folder becomes a session by the questions of `calib new`; a file of this computer is not read."""
    folder = tmp_path / "new"
    client = TestClient(application(Recorded(folder)), base_url="http://127.0.0.1:8000")
    assert "New calibration session" in client.get("/").text
    answers = {"robot": "ur5", "instrument": "cmm", "dynamics": "no", "poses": "12", "plan": "no", "holdout": "0.25"}
    for key, value, words in (
        ("robot", "/etc/passwd", "no robot of the library"),
        ("holdout", "a quarter", "a share from 0 to 0.99"),
        ("holdout", "2", "a share from 0 to 0.99"),
        ("cone", "wide", "--cone"),
        ("robot", "", "a robot and an instrument are needed"),
    ):
        refused = client.post("/new", data=answers | {key: value})
        assert refused.status_code == 400 and words in unescape(refused.text) and not folder.exists()
    assert client.post("/new", data=answers, headers={"origin": "http://evil.example"}).status_code == 403
    robot = {"robot_file": ("arm.xacro", b"<robot/>")}
    assert "expected a file .urdf or .toml" in client.post("/new", data=answers, files=robot).text
    named = answers | {"robot": "", "robot_file": str(tmp_path / "robot.urdf")}
    assert client.post("/new", data=named).status_code == 400, "a path is no uploaded file"
    # as a browser sends the field of a file that was not chosen
    assert client.post("/new", data=answers, files={"robot_file": ("", b"")}).status_code == 200
    settings = open_session(folder).settings
    assert (settings.poses.plan, settings.poses.fit, settings.fit.holdout) == (False, 12, 0.25)
    assert "Bring files" in client.get("/").text and client.get("/bundle/1-robot.zip").status_code == 404


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


def test_figures_of_a_step_are_a_page_that_runs_its_own_scripts(session: Session, client: TestClient) -> None:
    chart = Chart([Panel([Line([0.0, 1.0], [1.0, 2.0])])], 2.0)
    session.path("4-fit").mkdir(exist_ok=True)
    figure_data.write(session.path("4-fit"), {"joints": (chart, "errors by joint")})
    assert '<a href="/figures/4-fit/figures.json">' in client.get("/").text
    answer = client.get("/figures/4-fit/figures.json")
    assert "errors by joint" in answer.text and "script-src 'sha256-" in answer.headers["content-security-policy"]
    assert client.get("/figures/session.toml").status_code == client.get("/figures/5-validation").status_code == 404


def test_only_the_sessions_files_are_served(session: Session, client: TestClient, tmp_path: Path) -> None:
    (tmp_path / "secret.txt").write_text("mine")
    session.path("link.txt").symlink_to(tmp_path / "secret.txt")
    for name in ("../secret.txt", "%2e%2e/secret.txt", "link.txt", ".hidden", "/etc/passwd"):
        assert client.get(f"/files/{name}").status_code == 404
    assert "sandbox" in client.get("/files/session.toml").headers["content-security-policy"]


@pytest.fixture
def browser() -> Iterator[Any]:
    with chromium() as driver:
        driver.implicitly_wait(10)
        yield driver


def split(path: Path, joints: int) -> list[Path]:
    """Write joint values and points of a file of measured poses into two files, and return their paths."""
    lines = [line.split(",") for line in path.read_text().splitlines() if not line.startswith("#")]
    start = next(k for k, name in enumerate(lines[0]) if name.startswith("x"))
    parts = {"joints.csv": slice(start - joints, start), "points.csv": slice(start, None)}
    for name, columns in parts.items():
        path.with_name(name).write_text("".join(",".join(line[columns]) + "\n" for line in lines))
    return [path.with_name(name) for name in parts]


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

    def press(button: str) -> None:
        # the page may exchange the button between being found and being clicked
        browser.execute_script(f'document.querySelector("{button}")?.click()')

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

        screen = {"width": NARROW, "height": 900, "deviceScaleFactor": 1, "mobile": True}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
        twin = session.folder.with_name("twin")
        shutil.copytree(session.folder, twin)
        demo.simulate_measurements(open_session(twin), virtual_cell("lwr4plus"), 0)
        large = twin / "3-measured/measured.csv"
        large.write_text(large.read_text() + "# filling\n" * 300_000)  # more than a server keeps in memory
        apart = split(twin / "3-measured/validation_measured.csv", 7)
        for kind, paths in (("measured", [large]), ("validation", apart)):
            form = browser.find_element("css selector", f"form[action='/bring/{kind}']")
            form.find_element("css selector", "input").send_keys("\n".join(map(str, paths)))
            form.find_element("css selector", "button").click()
            if kind == "validation":
                # as on a telephone: nothing is wider than the screen
                until(lambda: "Joined: " in text("brought-validation"))
                assert "joined by row" in text("brought-validation")
                assert browser.execute_script("return document.documentElement.scrollWidth") <= NARROW
                press("form[action='/take/validation'] button")
            until(lambda kind=kind: "rows of kind" in text(f"brought-{kind}"))
        assert session.path("3-measured/measured.csv").read_bytes() == large.read_bytes()
        until(lambda: browser.find_elements("css selector", "button.main"))
        browser.find_element("css selector", "button.main").click()
        until(lambda: "certificate.html" in text() and "Complete" in text())
        assert go_on(open_session(session.folder)) is None
    finally:
        served.process.send_signal(signal.SIGINT)
        served.process.wait(20)


@pytest.mark.slow
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
