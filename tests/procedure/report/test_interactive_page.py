"""The page of a report in a browser: figures that are hovered, zoomed, switched, turned; tables that are sorted."""

import base64
import hashlib
import json
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browsers import chromium

from calib import files
from calib.procedure.report.certificate import rendering
from calib.procedure.report.certificate.record import Page
from calib.procedure.report.figures import figure_data, figure_files
from calib.procedure.report.figures.charts import MAX_NAME, MAX_TITLE, MAX_UPRIGHT_NAME, Captioned, Chart, Line, Panel
from calib.procedure.report.figures.drawing import figure
from calib.procedure.report.figures.svg import svg
from calib.procedure.report.geometry_figures import (
    correlation_map,
    error_histogram,
    error_map,
    image_coverage,
    residuals_by_joint,
)
from calib.procedure.report.page import Pictures, ReportTable, Section, Text, chart_pictures
from calib.procedure.report.templates import read, script_sources

HOSTILE = "</script><script>document.title='taken'</script>"
SAMPLES = 400_000
BROWSER = "calib.procedure.report.figures.browser"


def recording(samples: int, joints: int = 2) -> dict[str, Captioned]:
    """Return linked charts of torques and velocities with this many samples per curve, with a peak of one sample."""
    t = np.arange(samples) / 100.0
    panels, velocities = [], []
    for j in range(joints):
        torque = np.sin(t * (j + 1))
        torque[samples // 3] = 9.0
        curves = [Line(t, torque, label="measured"), Line(t, 0.1 * torque, label="residual")]
        panels.append(Panel(curves, f"joint {j + 1}", "time [s]", xlim=(t[0], t[-1]), switch=f"joint {j + 1}"))
        velocities.append(Line(t, np.cos(t), label=f"v{j + 1}", switch=f"joint {j + 1}"))
    torques = Chart(panels, 0.7 + 0.95 * joints, title=HOSTILE, shared="x", linked="1")
    velocity = Chart([Panel(velocities, x="time [s]", y="velocity", xlim=(t[0], t[-1]))], 2.0, linked="1")
    return {"torque_1": (torques, f"torques {HOSTILE}"), "velocity_1": (velocity, "velocities")}


def geometry(count: int = 60) -> dict[str, Captioned]:
    rng = np.random.default_rng(0)
    before, after = rng.gamma(4.0, 1e-3, count), rng.gamma(4.0, 1e-5, count)
    q, points = rng.uniform(-2.0, 2.0, (count, 3)), rng.normal(size=(count, 3))
    by_joint = residuals_by_joint(q, before, after, ["j1", "j2", "j3"], [False] * 3)
    details = {"row": np.arange(1.0, count + 1.0), "σ [mm]": 1e3 * after}
    by_row = Panel([Line(details["row"], 1e3 * after, ".")], "unseen rows of a.csv", "row", "error [mm]")
    return {
        "position": (error_histogram(before, after), "errors"),
        "joints": (Chart(by_joint.panels, by_joint.height, by_joint.columns, points=details), "by joint"),
        "map": (error_map(points, after), "map"),
        "rows": (Chart([by_row], 2.0), "by row"),
        "correlations": (correlation_map(["a", "b", HOSTILE], np.eye(3)), "correlations"),
        "coverage": (image_coverage((640, 480), rng.integers(0, 3, (6, 8)), rng.uniform(size=(6, 8))), "corners"),
    }


def written(folder: Path, charts: dict[str, Captioned]) -> Path:
    """Write a page with these figures, a table and a finding, and the files beside it; return its path."""
    rows = [["beta", "10 mm"], ["alpha", "9 mm"], ["gamma", "–"]]
    notes = Text("Notes", ["a.csv: rows 3–5 and 7 fit worse", HOSTILE])
    table = ReportTable("Values", ("name", "value"), rows, numbers=(1,))
    figures = Pictures("Figures", list(chart_pictures(charts).values()))
    report = Page("Report", HOSTILE, "", "", [Section("Part", [figures, table, notes])])
    for name, content in figure_data.whole_figures(charts):
        files.write(folder / name, content)
    return files.write(folder / "report.html", rendering.html(report))


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as driver:
        yield driver


def opened(browser: Any, page: Path) -> None:
    browser.get_log("browser")
    browser.get(page.as_uri())
    browser.execute_script("window.scrollTo(0, document.body.scrollHeight); window.scrollTo(0, 0)")
    settled(browser, "return document.querySelectorAll('figure.chart:not([data-drawn])').length == 0 || 'undrawn'")


def settled(browser: Any, script: str) -> None:
    """Wait until a script returns True."""
    from selenium.webdriver.support.ui import WebDriverWait

    WebDriverWait(browser, 15).until(lambda driver: driver.execute_script(script) is True)


def hover(browser: Any, selector: str, x: float = 0.5, y: float = 0.5) -> str:
    """Point at a share of an element's size, and return what is read there."""
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.by import By

    element = browser.find_element(By.CSS_SELECTOR, selector)
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", element)
    offset = int((x - 0.5) * element.size["width"]), int((y - 0.5) * element.size["height"])
    ActionChains(browser, duration=20).move_to_element_with_offset(element, *offset).move_by_offset(1, 0).perform()
    return browser.execute_script("const t = document.querySelector('.tip'); return t.hidden ? '' : t.innerText")


def press(browser: Any, selector: str, *keys: str) -> None:
    from selenium.webdriver.common.by import By

    browser.find_element(By.CSS_SELECTOR, selector).send_keys(*keys)


PANEL = "#figure-torque_1 .panel:nth-child(1)"


@pytest.mark.slow
def test_page_is_read_zoomed_and_switched(browser, tmp_path):
    """Torques are hovered and zoomed with a linked cursor, and one legend switches joints in all figures."""
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.by import By

    opened(browser, written(tmp_path, recording(3000)))
    tip = hover(browser, f"{PANEL} .u-over")
    assert "time [s] 15" in tip and "measured" in tip and "residual" in tip
    linked = browser.find_element(By.CSS_SELECTOR, "#figure-velocity_1 .reading").get_attribute("textContent")
    assert "time [s] 15" in linked and "v1" in linked and "v2" in linked
    over = browser.find_element(By.CSS_SELECTOR, f"{PANEL} .u-over")
    ticks = "return [...document.querySelectorAll('.reading')].map(r => r.textContent)"
    ActionChains(browser).move_to_element_with_offset(over, -50, 0).click_and_hold().move_by_offset(
        100, 0
    ).release().perform()
    hover(browser, f"{PANEL} .u-over", 0.02)
    begin = float(re.search(r"time \[s\] ([\d.]+)", browser.execute_script(ticks)[-1])[1])
    assert begin == pytest.approx(15.0 - 30.0 * 50 / over.size["width"], abs=0.4), "all linked figures are zoomed"
    press(browser, PANEL, "0")
    hover(browser, f"{PANEL} .u-over", 0.02)
    assert float(re.search(r"time \[s\] ([\d.]+)", browser.execute_script(ticks)[-1])[1]) < 1.0
    browser.find_element(By.CSS_SELECTOR, ".switches [data-switch='joint 2']").click()
    shown = browser.execute_script(
        "return [...document.querySelectorAll('#figure-torque_1 .panel')].map(p => !p.hidden)"
    )
    assert shown == [True, False]
    assert "v2" not in hover(browser, "#figure-velocity_1 .u-over")
    assert browser.title != "taken" and not browser.get_log("browser"), "no errors, and no name becomes a script"


@pytest.mark.slow
def test_true_samples_are_loaded_when_looked_at(browser, tmp_path):
    """An hour's log is thinned in the page, without loss of peaks; zoomed, all samples come from the file beside it."""
    charts = recording(SAMPLES)
    page = written(tmp_path, charts)
    assert page.stat().st_size < 1_500_000
    thin, _ = figure_data.read(page)["torque_1"]
    assert len(thin.panels[0].layers[0].x) < 3000 and max(thin.panels[0].layers[0].y) == pytest.approx(9.0, abs=1e-3)
    assert {path.name for path in tmp_path.iterdir()} == {"report.html", "figure_torque_1.js", "figure_velocity_1.js"}
    opened(browser, page)
    press(browser, PANEL, "+", "+", "+")
    settled(browser, "return document.querySelector('#figure-torque_1').dataset.whole == 'yes'")
    (tmp_path / "figure_torque_1.js").unlink()
    opened(browser, page)
    press(browser, PANEL, "+", "+", "+")
    settled(browser, "return !!document.querySelector('#figure-torque_1 .note')")
    note = browser.execute_script("return document.querySelector('#figure-torque_1 .note').textContent")
    assert "figure_torque_1.js, which is not beside this page" in note


@pytest.mark.slow
def test_points_tell_row_and_sigma_and_findings_lead_to_them(browser, tmp_path):
    """A point tells its row and σ, a finding's rows lead to their points, the map turns, and a table is sorted."""
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.by import By

    charts = geometry()
    opened(browser, written(tmp_path, charts))
    canvas = "#figure-map canvas.space"
    before = browser.execute_script(f"return document.querySelector('{canvas}').toDataURL()")
    element = browser.find_element(By.CSS_SELECTOR, canvas)
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", element)
    ActionChains(browser).move_to_element(element).click_and_hold().move_by_offset(60, 20).release().perform()
    turned = browser.execute_script(f"return document.querySelector('{canvas}').toDataURL()")
    press(browser, canvas, "0")
    assert turned != before == browser.execute_script(f"return document.querySelector('{canvas}').toDataURL()")
    tips = [hover(browser, "#figure-joints .panel .u-over", x, y) for x in (0.3, 0.5, 0.7) for y in (0.3, 0.8)]
    assert any("row" in tip and "σ [mm]" in tip for tip in tips)
    assert "poses" in hover(browser, "#figure-position .u-over")
    link = browser.find_element(By.CSS_SELECTOR, "a.rows")
    assert (link.text, link.get_attribute("data-rows")) == ("rows 3–5 and 7", "3,4,5,7")
    picture = "return document.querySelector('#figure-rows .u-wrap canvas').toDataURL()"
    plain = browser.execute_script(picture)
    link.click()
    settled(browser, f"{picture} != {json.dumps(plain)}")
    head = browser.find_elements(By.CSS_SELECTOR, "th.sortable")[1]
    names = "return [...document.querySelectorAll('tbody td:first-child')].map(c => c.textContent).join()"
    head.click()
    assert browser.execute_script(names) == "alpha,beta,gamma" and head.get_attribute("aria-sort") == "ascending"
    head.send_keys(" ")
    assert browser.execute_script(names) == "beta,alpha,gamma", "what is no number stands last"
    assert not browser.get_log("browser")


@pytest.mark.slow
def test_links_mark_rows_of_the_file_that_the_finding_names(browser, tmp_path):
    """Row 3 of b.csv is marked in the panel of b.csv alone, and among points of both files once."""
    rows = np.arange(1.0, 11.0)
    panels = [
        Panel([Line(rows, rows, ".")], f"fitted rows of {name}", "row", file=name) for name in ("ab.csv", "b.csv")
    ]
    details = {"row": np.tile(rows, 2), "file": np.repeat([0.0, 1.0], 10)}
    by_joint = Panel([Line(np.arange(20.0), np.ones(20), ".")], x="q1")
    charts = {
        "rows": (Chart(panels, 3.0), "by row"),
        "joints": (Chart([by_joint], 2.0, points=details, files=("ab.csv", "b.csv")), "by joint"),
    }
    report = Page(
        "Report",
        "",
        "",
        "",
        [
            Section(
                "Part",
                [
                    Pictures("Figures", list(chart_pictures(charts).values())),
                    Text("Notes", ["outliers: row 3 of b.csv", "ab.csv: rows 2 and 3 differ", "row 3 is far off"]),
                ],
            )
        ],
    )
    opened(browser, files.write(tmp_path / "report.html", rendering.html(report)))
    links = browser.find_elements("css selector", "a.rows")
    assert [link.get_attribute("data-file") for link in links] == ["b.csv", "ab.csv", ""]
    pictures = "return [...document.querySelectorAll('.panel .u-wrap canvas')].map(c => c.toDataURL())"
    plain = browser.execute_script(pictures)
    expected = [(False, True, True), (True, False, True), (True, True, True)]
    for link, changed in zip(links, expected):
        link.click()
        settled(
            browser,
            f"return [...document.querySelectorAll('.panel .u-wrap canvas')][2].toDataURL() != {json.dumps(plain[2])}",
        )
        now = browser.execute_script(pictures)
        assert tuple(before != after for before, after in zip(plain, now)) == changed
    assert "file b.csv" in hover(browser, "#figure-joints .panel .u-over", 0.75, 0.5)


def test_long_names_keep_their_ends():
    names = [f"robot_cell_left_arm_long_shoulder_joint_{number}" for number in range(1, 4)]
    chart = Chart([Panel([], name, f"{name} [deg]", ynames=names, xnames=names) for name in names], 2.0, columns=3)
    panel = chart.panels[1]
    assert panel.title.endswith("joint_2") and panel.x.endswith("joint_2 [deg]") and len(panel.x) == MAX_TITLE
    assert panel.xnames[2].endswith("joint_3") and len(panel.xnames[2]) == MAX_UPRIGHT_NAME
    assert panel.ynames[0].startswith("robot_") and len(panel.ynames[0]) == MAX_NAME
    alike = [f"joint_{middle}_of_the_left_arm_of_the_robot_cell" for middle in "ab"]
    assert Panel([], xnames=alike).xnames == alike


@pytest.mark.slow
def test_page_is_narrow_dark_printed_and_told(browser, tmp_path):
    """It fits 400 px, is drawn on dark paper, prints all figures, and tells what they show."""
    page = written(tmp_path, recording(3000, joints=30) | geometry())
    size = {"width": 400, "height": 800, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    dark = {"features": [{"name": "prefers-color-scheme", "value": "dark"}]}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", dark)
    browser.get_log("browser")
    browser.get(page.as_uri())
    settled(browser, "return document.querySelector('figure.chart').dataset.drawn == 'yes'")
    assert browser.execute_script("return document.documentElement.scrollWidth") <= 400
    assert browser.execute_script("return getComputedStyle(document.querySelector('main')).backgroundColor") == (
        "rgb(27, 30, 34)"
    )
    document = browser.execute_cdp_cmd("Page.printToPDF", {})["data"]
    assert len(base64.b64decode(document)) > 50_000
    undrawn = browser.execute_script("return document.querySelectorAll('figure.chart:not([data-drawn])').length")
    assert undrawn == 0 and browser.execute_script("return document.querySelectorAll('.panel').length") >= 34
    labels = browser.execute_script(
        "return [...document.querySelectorAll('.plot')].map(p => p.getAttribute('aria-label'))"
    )
    assert all(len(label) > 10 for label in labels) and "measured: -1 to 9." in browser.execute_script(
        f"return document.querySelector('{PANEL}').getAttribute('aria-label')"
    )
    assert not browser.get_log("browser")
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


def test_page_without_scripts_says_where_the_numbers_are(tmp_path):
    page = written(tmp_path, geometry()).read_text(encoding="utf-8")
    assert page.count("The tables hold the numbers; <code>--plots png</code>") == len(geometry())
    assert page.count('<noscript><img alt="" src="data:image/svg+xml;base64,') == len(geometry())
    assert not re.search(r"<script[^>]*src|<link|@import|https?://(?!www\.w3\.org)", re.sub(r"/\*.*?\*/", "", page))


def test_stored_figures_are_those_that_were_written(tmp_path):
    """Charts come back from a page and from figures.json, and are drawn by matplotlib and as SVG like those written."""
    charts = geometry() | recording(600)
    figure_data.write(tmp_path, charts)
    for path in (tmp_path / figure_data.NAME, written(tmp_path, charts)):
        read_back = figure_data.read(path)
        assert list(read_back) == list(charts)
        for name, (chart, caption) in charts.items():
            again, caption_again = read_back[name]
            assert caption_again == caption and len(again.panels) == len(chart.panels)
            assert svg(again).startswith(b"<svg") and HOSTILE.encode() not in svg(again)
    drawn, again = (figure(one["map"][0]) for one in (charts, read_back))
    assert [axes.get_title(loc="left") for axes in again.axes] == [axes.get_title(loc="left") for axes in drawn.axes]
    assert read_back["coverage"][0].panels[0].layers[0].limits == (0.0, None)
    curve = charts["torque_1"][0].panels[0].layers[0]
    stored = figure_data.read(tmp_path / figure_data.NAME)["torque_1"][0].panels[0].layers[0]
    np.testing.assert_allclose(stored.y, curve.y, atol=10.0 / 65535)
    np.testing.assert_allclose(stored.x, curve.x, rtol=1e-6)


def test_drawings_are_files_of_their_names(tmp_path):
    """Asked for, each figure is a file; otherwise none is, and without a page the data are."""
    charts = {"rows": geometry()["rows"]}
    for plots, paged, names in (
        (False, False, []),
        (True, True, []),
        (True, False, ["figures.json"]),
        ("svg", True, ["plot_rows.svg"]),
        ("png", True, ["plot_rows.png"]),
    ):
        folder = tmp_path / f"{plots} {paged}"
        folder.mkdir()
        figure_files.write(folder, charts, plots, paged)
        assert sorted(path.name for path in folder.iterdir()) == names


def test_vendored_files_are_those_published():
    table = tomllib.loads(read(BROWSER, "vendored.toml"))["uplot"]
    for name, digest in table["sha256"].items():
        assert hashlib.sha256(read(BROWSER, name).encode()).hexdigest() == digest
    assert "MIT License" in read(BROWSER, "uPlot.LICENSE") and table["version"] in read(BROWSER, "uPlot.iife.min.js")


@pytest.mark.slow
def test_served_page_runs_its_own_scripts_alone(browser, tmp_path):
    """Under the policy of `calib serve` the page is drawn, and a script that somebody added does not run."""
    from calib.apps.serve.pages import SANDBOX

    page = written(tmp_path, geometry()).read_text(encoding="utf-8")
    added = page.replace("</body>", "<script>document.title = 'taken'</script></body>")
    policy = SANDBOX.format(script_sources()).partition("; sandbox")[0]
    head = f'<head><meta http-equiv="Content-Security-Policy" content="{policy}">'
    opened(browser, files.write(tmp_path / "served.html", added.replace("<head>", head, 1)))
    assert browser.title != "taken" and "has been blocked" in str(browser.get_log("browser"))
