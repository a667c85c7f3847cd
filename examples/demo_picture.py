"""Run `calib demo` (seed 0), keep its picture as `demo.png`, and put its figures into the README.

python examples/demo_picture.py            # the picture holds the figures, too (text "figures" of the PNG)
"""

from __future__ import annotations

import json
import re
import tempfile
import time
from pathlib import Path

from PIL import Image
from PIL.PngImagePlugin import PngInfo

from calib.apps.cell_demo import demo
from calib.apps.cell_demo.step_lines import PICTURE, position_errors, torque_error
from calib.procedure.export.delivery import prediction
from calib.procedure.session.folder import Session
from calib.workers.threads import one_blas_thread

PICTURE_FILE = Path(__file__).with_name("demo.png")
README = Path(__file__).parents[1] / "README.md"
SENTENCES = (  # of the README: where a figure stands, and its form
    "unseen poses: {nominal_mm:.2f} mm before, {calibrated_mm:.2f} mm after",
    "unseen motion: {exported_percent:.1f} % of torque unexplained (identified model {unexplained_percent:.1f} %)",
    "demo {within_two_sigma_percent:.0f} % within 2σ",
)
FIELD = re.compile(r"\{(\w+):(\S+)\}")


def main() -> None:
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "demo"
        values = run(folder)
        metadata = PngInfo()
        metadata.add_text("figures", json.dumps(values))
        with Image.open(folder / PICTURE) as image:
            image.save(PICTURE_FILE, pnginfo=metadata, dpi=image.info["dpi"])
    text = README.read_text(encoding="utf-8")
    for sentence in SENTENCES:
        text = pattern(sentence).sub(sentence.format(**values), text)
    README.write_text(text, encoding="utf-8")
    print(json.dumps(values, indent=1))


def run(folder: Path) -> dict[str, float]:
    """Run the demonstration in a new folder; return its figures for README and picture."""
    started = time.process_time()
    with one_blas_thread():  # as in the command
        result = demo.run(folder, demo.ROBOT, 0, print, _say_nothing, plots="png")
    seconds = time.process_time() - started
    return figures(result.session) | {"processor_seconds": seconds, "memory_mb": result.memory}


def _say_nothing(message: object) -> None:
    """Leave out the progress of the demonstration."""


def figures(session: Session) -> dict[str, float]:
    """Return the figures of a finished demonstration, without time and memory."""
    truth = json.loads(session.path("truth.json").read_text(encoding="utf-8"))
    nominal, calibrated = position_errors(session)
    return {
        "nominal_mm": nominal,
        "calibrated_mm": calibrated,
        "unexplained_percent": torque_error(session),
        "exported_percent": prediction(session.path(session.export)).exported,
        "within_two_sigma_percent": 100.0 * truth["within_two_sigma"],
    }


def pattern(sentence: str) -> re.Pattern[str]:
    """Return the pattern that finds a sentence in the README, with one group per figure."""
    escaped = re.escape(sentence).replace(r"\{", "{").replace(r"\}", "}")
    return re.compile(FIELD.sub(r"([\\d.]+)", escaped))


def readme_figures() -> dict[str, tuple[float, float]]:
    """Return the figures of the README by name, each with half of its last digit."""
    text = README.read_text(encoding="utf-8")
    values: dict[str, tuple[float, float]] = {}
    for sentence in SENTENCES:
        match = pattern(sentence).search(text)
        assert match, f"README does not say '{sentence}'"
        names = [name for name, _ in FIELD.findall(sentence)]
        for name, digits in zip(names, match.groups(), strict=True):
            decimals = len(digits.partition(".")[2])
            values[name] = (float(digits), 0.5 * 10.0**-decimals)
    return values


def picture_figures() -> dict[str, float]:
    """Return the figures shown in the picture."""
    with Image.open(PICTURE_FILE) as image:
        return json.loads(image.info["figures"])


if __name__ == "__main__":
    main()
