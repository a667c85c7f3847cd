"""Run the demonstration (seed 0), draw `demo.png` of it, and put its figures into the README.

python examples/demo_picture.py            # the picture holds the figures, too (text "figures" of the PNG)
"""

from __future__ import annotations

import json
import re
import tempfile
import time
from pathlib import Path

import numpy as np
from PIL import Image

from calib.procedure.report.style import AFTER, BEFORE, PAGE_WIDTH, QUIET, legend, log_axis, sheet, styled
from calib.procedure.session.folder import Session
from calib.rooms.cells import demo
from calib.workers.threads import one_blas_thread

PICTURE = Path(__file__).with_name("demo.png")
README = Path(__file__).parents[1] / "README.md"
SENTENCES = (  # of the README: where a figure stands, and its form
    "{nominal_mm:.2f} mm before, {calibrated_mm:.2f} mm after",
    "{unexplained_percent:.1f} % of the torque unexplained",
    "{processor_seconds:.0f} s of processor time once compiled; {memory_mb:.0f} MB",
    "demo, unseen poses: {calibrated_mm:.2f} mm with, {urdf_alone_mm:.2f} mm without",
    "demo {within_two_sigma_percent:.0f} % within 2σ",
)
FIELD = re.compile(r"\{(\w+):(\S+)\}")


def main() -> None:
    with tempfile.TemporaryDirectory() as place:
        found, figures = run(Path(place) / "demo")
        draw(found.session, found.verdict, figures)
    text = README.read_text(encoding="utf-8")
    for sentence in SENTENCES:
        text = pattern(sentence).sub(sentence.format(**figures), text)
    README.write_text(text, encoding="utf-8")
    print(json.dumps(figures, indent=1))


def run(folder: Path) -> tuple[demo.DemoResult, dict[str, float]]:
    """Run the demonstration in a new folder; return its result, and its figures for README and picture."""
    began = time.process_time()
    with one_blas_thread():  # as in the command
        found = demo.run(folder, "lwr4plus", 0, print, lambda words: None)
    seconds, session = time.process_time() - began, found.session
    truth = json.loads(session.path("truth.json").read_text(encoding="utf-8"))
    (unseen,) = _read(session.validation.path / "metrics.json")["validation"].values()
    arms = {name: unseen[name]["position_mm"]["rms"] for name in ("nominal", "calibrated", "urdf_alone")}
    (torques,) = session.identification.unseen.read().proofs.values()
    return found, {
        **{f"{name}_mm": value for name, value in arms.items()},
        "poses": unseen["poses"],
        "unexplained_percent": torques.raw.relative_error_percent.total,
        "within_two_sigma_percent": 100.0 * truth["within_two_sigma"],
        "processor_seconds": seconds,
        "memory_mb": found.memory,
    }


def pattern(sentence: str) -> re.Pattern[str]:
    """Return the pattern that finds a sentence in the README, with one group per figure."""
    return re.compile(FIELD.sub(r"([\\d.]+)", re.escape(sentence).replace(r"\{", "{").replace(r"\}", "}")))


def stated() -> dict[str, list[tuple[float, float]]]:
    """Return the figures of the README by name, each with half of its last digit."""
    text, result = README.read_text(encoding="utf-8"), dict[str, list[tuple[float, float]]]()
    for sentence in SENTENCES:
        found = pattern(sentence).search(text)
        assert found, f"README does not say '{sentence}'"
        for (name, _), digits in zip(FIELD.findall(sentence), found.groups(), strict=True):
            half = 0.5 * 10.0 ** -len(digits.partition(".")[2])
            result.setdefault(name, []).append((float(digits), half))
    return result


def drawn() -> dict[str, float]:
    """Return the figures shown in the picture."""
    with Image.open(PICTURE) as image:
        return json.loads(image.info["figures"])


def draw(session: Session, verdict: str, figures: dict[str, float]) -> None:
    """Draw the tool errors on validation poses, and the largest joint torque on the validation motion."""
    report = _read(session.validation.path / "report.json")
    (rows,) = (one for one in report["sets"] if one["unseen"])
    before, after = (1e3 * np.sort(rows[arm]["position"]) for arm in ("nominal", "calibrated"))
    unseen = session.identification.unseen.read()
    curves = unseen.curves[0]
    t, measured, predicted = (np.array(each, dtype=float).T for each in (curves.t, curves.measured, curves.predicted))
    row = int(np.argmax(np.linalg.norm(measured, axis=0)))
    with styled():
        figure, (poses, torque) = sheet(1, 2, PAGE_WIDTH, 2.9, head=0.3)
        place = np.arange(1, len(before) + 1)
        for errors, colour, name in ((before, BEFORE, "nominal"), (after, AFTER, "calibrated")):
            poses.plot(place, errors, "o", color=colour, markersize=4.0)
            poses.annotate(name, (place[-1], errors[-1]), (0, 6), textcoords="offset points", color=colour, ha="right")
        log_axis(poses.yaxis, 0.8 * after[0], 1.5 * before[-1])
        poses.set(xlabel="unseen poses, by error", ylabel="error of the tool [mm]")
        poses.set_title(f"Geometry: {figures['nominal_mm']:.2f} → {figures['calibrated_mm']:.2f} mm rms")
        for values, colour, width, name in (
            (measured[:, row], BEFORE, 1.6, "measured"), (predicted[:, row], AFTER, 0.8, "predicted"),
            (measured[:, row] - predicted[:, row], QUIET, 0.6, "left"),
        ):  # fmt: skip
            torque.plot(t, values, color=colour, linewidth=width, label=name)
        torque.set(xlabel="time of an unseen motion [s]", ylabel=f"{unseen.rows[row]} [{unseen.units[row]}]")
        torque.set_title(f"Dynamics: {figures['unexplained_percent']:.1f} % of torque unexplained")
        legend(figure, torque, f"calib demo, a simulated KUKA LWR4+; verdict: {verdict}")
        figure.savefig(PICTURE, dpi=130, metadata={"figures": json.dumps(figures)})


def _read(path: Path) -> dict:
    return json.loads(path.read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
