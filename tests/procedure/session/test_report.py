"""Report and certificate of a session are files that load nothing, say what they have to, and the figures are right."""

import hashlib
import io
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image
from pypdf import PdfReader
from sessions import edit, go_on
from without_figures import run

from calib.errors import CalibError
from calib.geometry.model_choice.ladder import ModelStep
from calib.procedure.report import fit_report, geometry_figures
from calib.procedure.report.certificate import rendering, results
from calib.procedure.report.figures import drawing, figure_data, sheets, style
from calib.procedure.session.folder import Session


class References(HTMLParser):
    """Collects what a page would load, and its text."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.loaded, self.tags, self.text = list[str](), list[str](), list[str]()
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.loaded += [value or "" for name, value in attrs if name in ("src", "href", "xlink:href", "data", "srcset")]

    def handle_data(self, data: str) -> None:
        self.text.append(data)


@pytest.fixture(scope="module")
def page(finished_folder: Path) -> str:
    return (finished_folder / "report.html").read_text()


@pytest.fixture(scope="module")
def first(finished_folder: Path) -> str:
    return (finished_folder / "certificate.html").read_text()


@pytest.fixture(scope="module")
def text(page: str) -> str:
    return " ".join(" ".join(References(page).text).split())


def test_they_load_nothing_from_anywhere(page: str, first: str) -> None:
    for one in (page, first):
        found = References(one)
        assert all(reference.startswith(("#", "data:")) for reference in found.loaded)
        assert not {"link", "iframe", "object", "base"} & set(found.tags)
        assert "@import" not in one and not re.search(r"url\((?!#)", one)
        assert len(one) < 1_500_000


def test_it_says_what_a_professional_signs(text: str, finished_folder: Path) -> None:
    metrics = json.loads((finished_folder / "5-validation/metrics.json").read_text())
    rms = metrics["validation"]["validation_measured.csv"]["calibrated"]["position_mm"]["rms"]
    stated = {metrics["verdict"].upper(), metrics["reason"][1:], f"{rms:.3f}", "seed", "numpy", "Limitations"}
    robot = {"lwr4plus", "optical CMM", "60 µm", "3-measured/measured.csv", "theta2", "d4", "alpha7"}
    assert all(words in text for words in stated | robot | {"kept at their nominal values: alpha1"})
    digest = re.findall(r"\b[0-9a-f]{64}\b", text)
    assert len(digest) == len(set(digest)) >= 6


def test_simulated_session_alone_says_it_is(page: str, first: str, finished: Session) -> None:
    """A simulated session says that it is, and another does not."""
    assert (
        all(">Simulated calibration of" in one for one in (page, first))
        and "SIMULATED: nothing was measured on a robot; optical CMM" in page
    )
    assert "simulated cell: " in page and "SIMULATED: nothing was measured on a robot" in first
    finished.path("simulated.txt").unlink()
    assert go_on(finished) is None
    assert all("imulated" not in finished.path(name).read_text() for name in ("certificate.html", "report.html"))


def test_certificate_states_the_numbers(finished: Session) -> None:
    """The certificate states the numbers of the data on four pages."""
    edit(finished.path("session.toml"), 'robot_serial = ""', 'robot_serial = "SN 4711"')
    edit(finished.path("session.toml"), "tolerance_mm = 0.0", "tolerance_mm = 0.3")
    assert go_on(finished, plots=True) is None
    document = PdfReader(finished.path("certificate.pdf"))
    assert len(document.pages) <= 4
    text = " ".join(" ".join(one.extract_text() for one in document.pages).split())
    rows = json.loads(finished.path("5-validation/metrics.json").read_text())["validation"]["validation_measured.csv"]
    before, after = (rows[arm]["position_mm"] for arm in ("nominal", "calibrated"))
    met = "yes" if after["rms"] <= 0.3 else "NO"
    assert re.search(rf"position, rms {before['rms']:.3g} mm {after['rms']:.3g} mm ± [\d.]+ mm .* 0.3 mm {met} ", text)
    assert all(f"{one[name]:.4f}" in text for one in (before, after) for name in ("mean", "rms", "p95", "max"))
    errors = fit_report.read(finished.path("5-validation/report.json")).sets[-1]
    worst = int(np.argmax(errors.calibrated["position"]))
    joints = ", ".join(f"{angle:.1f} deg" for angle in np.degrees(errors.q[worst]))
    assert (
        f"row {errors.rows[worst]} of validation_measured.csv: {after['max']:.3g} mm" in text
        and f"joints at {joints};" in text
    )
    assert "robot serial number SN 4711" in text and "ISO 9283" in text and "NOT checked" in text
    shown = finished.path("certificate.html").read_text()
    assert "SN 4711" in shown and shown.count('<span class="blank">') == 11 and str(finished.folder) not in shown + text
    assert shown.count("data:image/svg+xml;base64,") == 3


def test_arrival_notes_stand_on_certificate(text: str, finished_folder: Path) -> None:
    """What was noticed on arrival stands on the certificate."""
    lines = (finished_folder / "3-measured/checked.txt").read_text().splitlines()
    assert "Notes on the files when they were read" in text
    assert all(line in text for line in lines) and any(re.match("drift.csv: .* measured again", line) for line in lines)
    noted = json.loads((finished_folder / "5-validation/metrics.json").read_text())["warnings"]
    assert noted and all(text.count(line) == 1 for line in noted), "nothing is noted twice"
    assert all(f"{name}.csv: measured joint positions differ" in text for name in ("validation_measured", "measured"))


def test_page_holds_and_explains_all_figures(page: str, finished_folder: Path) -> None:
    """The data of every figure are in the page, which says what it shows."""
    figures = re.findall(r'data-figure="([^"]+)"><div class="plot" role="img" aria-label="([^"]+)">', page)
    assert len(figures) >= 7 and len(set(figures)) == len(figures)
    assert list(figure_data.of_folder(finished_folder)) == [name for name, _ in figures]
    assert not list(finished_folder.rglob("*.png")), "nothing is drawn that was not asked for"


def test_report_numbers_are_those_of_the_fit(finished_folder: Path) -> None:
    """Numbers of the report are those of the fit."""
    found = fit_report.read(finished_folder / "4-fit/report.json")
    metrics = json.loads((finished_folder / "4-fit/metrics.json").read_text())
    errors = 1e3 * np.array(found.sets[0].calibrated["position"])
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(metrics["fit"]["calibrated"]["position_mm"]["rms"], rel=1e-5)
    assert len(found.sets[0].q) == len(found.sets[0].points) == len(errors)
    assert found.noise["position"] == pytest.approx(60e-6 * np.sqrt(3))


@pytest.mark.slow
def test_fit_certificate_names_its_files(finished_folder: Path, tmp_path: Path) -> None:
    """A fit's own certificate names its files."""
    given = ("1-robot/robot.toml", "3-measured/measured.csv")
    assert not run("fit", *(finished_folder / name for name in given), "--model", "geometry", "--out", tmp_path / "fit")
    page = (tmp_path / "fit/report.html").read_text()
    assert not (finished_folder / "4-fit/certificate.html").exists(), "a session has one certificate"
    for name in given:
        digest = hashlib.sha256((finished_folder / name).read_bytes()).hexdigest()
        assert digest in page and f"<td>{Path(name).name}</td>" in page


def test_hostile_names_do_not_become_markup(finished_folder: Path) -> None:
    found = replace(fit_report.read(finished_folder / "4-fit/report.json"), robot="<script>alert(1)</script>")
    for one in results.of_fit(found, {}):
        assert "<script>" not in rendering.html(one) and "&lt;script&gt;" in rendering.html(one)


def test_another_versions_report_is_refused(finished_folder: Path, tmp_path: Path) -> None:
    content = json.loads((finished_folder / "4-fit/report.json").read_text()) | {"schema": 99}
    (tmp_path / "report.json").write_text(json.dumps(content))
    with pytest.raises(CalibError, match="schema 99"):
        fit_report.read(tmp_path / "report.json")


def test_correlated_names_do_not_overlap() -> None:
    """Names of correlated parameters do not overlap."""
    names = [f"shoulder_lift_joint.offset cos {k} shoulder_lift_joint" for k in range(12)]
    figure = drawing.figure(geometry_figures.correlation_map(names, 0.5 + 0.5 * np.eye(12)))
    figure.draw_without_rendering()
    axes = figure.axes[0].get_position()
    inches = axes.height * figure.get_figheight(), axes.width * figure.get_figwidth()
    assert min(inches) / len(names) > 6.5 / 72.0, "a line per name"


def test_before_and_after_differ_in_grey() -> None:
    """Before and after differ in greyscale."""

    def grey(colour: str) -> float:
        return float(np.dot(to_rgb(colour), (0.299, 0.587, 0.114)))

    assert grey(style.BEFORE) - grey(style.AFTER) > 0.35


def changed(names, units, changes, sigmas) -> list[fit_report.FittedParameter]:
    rows = zip(names, units, changes, sigmas)
    return [
        fit_report.FittedParameter(name, unit, 0.0, change, sigma, None, "arm") for name, unit, change, sigma in rows
    ]


@pytest.mark.slow
def test_figures_are_drawn_from_plain_arrays(tmp_path: Path) -> None:
    """Every figure is drawn from plain arrays."""
    rng = np.random.default_rng(0)
    before, after = rng.gamma(4.0, 1e-3, 60), rng.gamma(4.0, 1e-5, 60)
    q, points = rng.uniform(-2.0, 2.0, (60, 7)), rng.normal(size=(60, 3))
    names = [f"p{k}" for k in range(20)]
    drawn = [
        geometry_figures.error_histogram(before, after, noise=2e-5),
        geometry_figures.error_histogram(before, before, "orientation"),
        geometry_figures.residuals_by_joint(q, before, after, names[:7], [False] * 6 + [True]),
        geometry_figures.error_map(points, after),
        geometry_figures.parameter_changes(changed(names, ["m", "rad"] * 10, rng.normal(size=20), np.ones(20)), most=6),
        geometry_figures.parameter_changes(changed(names[:2], ["rad", "rad"], np.ones(2), np.ones(2))),
        geometry_figures.singular_values(np.array([3.0, 1.0, 1e-9, 0.0]), 2),
        geometry_figures.singular_values(np.array([3.0, 1.0]), 2),
        geometry_figures.ladder([ModelStep("frames", 12, 5.0, True), ModelStep("geometry", 34, 1.0, True)], 1e-4),
        geometry_figures.correlation_map(names, np.eye(20)),
    ]
    for number, figure in enumerate(map(drawing.figure, drawn)):
        assert isinstance(figure, Figure)
        path = sheets.save(figure, tmp_path / f"{number}.png", dpi=40)
        assert path.read_bytes()[:4] == b"\x89PNG"
        for axes in figure.axes:
            if axes.get_xlabel() and axes.axison:
                shared = axes.get_ylim() == figure.axes[0].get_ylim()  # then the leftmost has the labels
                assert axes.get_ylabel() or axes.get_yticklabels() or shared
    assert sorted(path.suffix for path in tmp_path.iterdir()) == [".png"] * len(drawn)


@pytest.mark.parametrize(
    "name",
    [
        "$q_1$",
        pytest.param("5 $", marks=pytest.mark.slow),
        "gelenk_€ $\\frac{1}$",
        pytest.param("a^b_c$$", marks=pytest.mark.slow),
    ],
)
def test_a_dollar_in_a_name_is_a_dollar(name: str) -> None:
    """Matplotlib would read what stands between two of them as mathematics, and fail where it is none."""
    changes, units = np.array([1e-3, 2e-3]), ["m", "rad"]
    figure = drawing.figure(geometry_figures.parameter_changes(changed([name, name], units, changes, changes / 9.0)))
    assert sheets.png(figure, dpi=40)[:4] == b"\x89PNG"
    labels = [label for axes in figure.axes for label in axes.get_yticklabels()]
    assert [(label.get_text(), label.get_parse_math()) for label in labels] == [(name, False)] * 2


@pytest.mark.slow
def test_paper_is_white_and_peaks_are_kept() -> None:
    one, two = (sheets.png(drawing.figure(geometry_figures.singular_values(np.ones(3), 3))) for _ in range(2))
    assert one == two, "drawn the same twice"
    picture = np.asarray(Image.open(io.BytesIO(one)).convert("RGB"))
    assert (picture[0, 0] == 255).all() and (picture == 255).mean() > 0.8
    t = np.linspace(0.0, 1.0, 100_000)
    values = np.zeros(len(t))
    values[[31_415, 92_653]] = 1.0, -1.0
    x, y = style.thinned(t, values)
    assert len(x) < 3 * style.STRETCHES and (np.diff(x) >= 0.0).all() and x[0] < 0.002 and x[-1] == 1.0
    assert x[y == 1.0] == t[31_415] and x[y == -1.0] == t[92_653]


def test_missing_data_are_left_out(finished_folder: Path) -> None:
    """What the data do not give is left out."""
    found = fit_report.read(finished_folder / "4-fit/report.json")
    bare = (replace(found.sets[0], q=(), points=()),)
    drawn = geometry_figures.captioned(replace(found, sets=bare, singular_values=()))
    assert "joints" not in drawn and "singular_values" not in drawn and "position" in drawn


def test_unchecked_and_predicted_stay_told(finished: Session) -> None:
    """What was not checked, and what was predicted, is repeated."""
    page = (finished.folder / "report.html").read_text()
    assert "poses NOT checked for" in page and "obstacles (not known)" in page and "self-collision (capsules" in page
    notes = json.loads((finished.folder / "state.json").read_text())["steps"]["fit"]["notes"]
    assert any(note.startswith("estimated σ / predicted σ") for note in notes)
    assert (finished.folder / "2-poses/poses_run.csv").read_text().startswith("t [s],pose,")


def test_files_of_the_same_name_are_told_apart_by_their_folders():
    assert fit_report.distinct_names(["a/m.csv", "b/m.csv", "a/n.csv"]) == ("a/m.csv", "b/m.csv", "n.csv")
    assert fit_report.distinct_names(["m.csv", "b/m.csv", ""]) == ("m.csv", "b/m.csv", "")
