"""The recipes of CONTRIBUTING, followed to the letter on a scratch copy: the files they name suffice, and the toolkit
shows the new thing."""

import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import planted
import pytest

from calib.robot.library import load

ROOT = Path(__file__).parents[1]
LIMIT_SECONDS = 240
STAGE = "calib/procedure/kinematic_stage"


@dataclass(frozen=True)
class Edit:
    """Replacement of a text that stands once in a file."""

    path: str
    before: str
    after: str

    def replaced_in(self, folder: Path) -> str:
        """Return the file's text with the replacement."""
        text = (folder / self.path).read_text(encoding="utf-8")
        assert text.count(self.before) == 1, f"{self.path} has changed: say the recipe's step in its new words"
        return text.replace(self.before, self.after)


FINDING = (
    Edit(
        "calib/procedure/findings.toml",
        "[joint-sign]\n",
        '[joint-hardly-moved]\nsays = "{joint} moved by {angle:.3g °} only"\n'
        'advice = "measure again with that joint over a larger range"\n'
        "\n[joint-sign]\n",
    ),
    Edit(
        f"{STAGE}/verdict/plausibility.py",
        '        finding("measured-range", joints=ranges(measured_range), **values),\n',
        '        finding("measured-range", joints=ranges(measured_range), **values),\n'
        '        finding("joint-hardly-moved", joint=measured_range.joints[0], angle=0.0087),\n',
    ),
)
OPTION = (
    Edit(
        f"{STAGE}/settings.py",
        "        seed: reproduces everything random\n        masses: folder",
        "        seed: reproduces everything random\n"
        "        fewest_poses: smallest number of poses\n        masses: folder",
    ),
    Edit(
        f"{STAGE}/settings.py",
        '    seed: Seed = 0\n    masses: Text = ""\n',
        '    seed: Seed = 0\n    fewest_poses: Annotated[int, Whole(3, 500)] = 3\n    masses: Text = ""\n',
    ),
)
EFFECT = (
    Edit(
        "calib/geometry/model_choice/ladder.py",
        "MODELS = CHOICES[1:]\n",
        "def _ratio(chain: Chain, torques_known: bool) -> list[Term]:\n"
        '    """Return the terms that correct a joint by its own reading: gear ratio."""\n'
        '    return [Term(chain.names[element], "joint", joint) for joint, element in enumerate(chain.moving)]\n\n\n'
        "MODELS = CHOICES[1:]\n",
    ),
    Edit("calib/geometry/model_choice/ladder.py", "_harmonics, _wobble)", "_harmonics, _wobble, _ratio)"),
    Edit("calib/data/poses/__init__.py", '"harmonics", "wobble")', '"harmonics", "wobble", "ratio")'),
)
FORMAT = (
    Edit(
        "calib/data/poses/robodk.py",
        "def _plain(name: str)",
        "def recognises_acme(header: Sequence[str]) -> bool:\n"
        '    """Return whether a header is that of an ACME table: joints [deg], then x y z [mm]."""\n'
        '    return tuple(header[:1]) == ("A1",)\n\n\n'
        "def read_acme(path: str | Path, joints: int, options: FileOptions) -> Read:\n"
        '    """Return the ACME table, options and notes, as `read_robodk`."""\n'
        '    header = (*(f"q{joint + 1}" for joint in range(joints)), "x", "y", "z")\n'
        '    units = ("deg",) * joints + ("mm",) * 3\n'
        '    return replace(read_table(path), header=header, units=units), options, ("read as a table of ACME",)\n\n\n'
        "def _plain(name: str)",
    ),
    Edit(
        "calib/data/poses/robodk.py",
        '    "robodk": (_is_robodk, read_robodk),\n',
        '    "robodk": (_is_robodk, read_robodk),\n    "acme": (recognises_acme, read_acme),\n',
    ),
    Edit("calib/data/poses/fit_options.py", '"robodk", "three_smr")', '"robodk", "three_smr", "acme")'),
)


class Copy:
    """A copy of the repository's tracked files, whose own calib its commands run."""

    def __init__(self, folder: Path):
        self.folder = folder
        tracked = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True)
        for name in filter(None, tracked.stdout.split("\0")):
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            if (ROOT / name).exists():
                shutil.copy2(ROOT / name, target, follow_symlinks=False)

    def apply(self, edits: tuple[Edit, ...]) -> None:
        for edit in edits:
            (self.folder / edit.path).write_text(edit.replaced_in(self.folder), encoding="utf-8")

    def python(self, *arguments: str, code: int = 0) -> str:
        """Run a module in the copy; return what it printed."""
        run = subprocess.run(
            [sys.executable, "-m", *arguments],
            cwd=self.folder,
            env=os.environ | {"PYTHONPATH": str(self.folder), "COLUMNS": "200", "NO_COLOR": "1"},
            capture_output=True,
            text=True,
            timeout=LIMIT_SECONDS,
        )
        assert run.returncode == code, run.stdout + run.stderr
        return run.stdout + run.stderr

    def calib(self, *arguments: str, code: int = 0) -> str:
        return self.python("calib", *arguments, code=code)

    def holds(self, *tests: str) -> None:
        """Run tests of the copy: they would name a further file that the recipe does not."""
        self.python("pytest", "-q", "-p", "no:cacheprovider", "-m", "not slow", *tests)


@pytest.fixture
def scratch(tmp_path: Path) -> Copy:
    if not (ROOT / ".git").exists() or shutil.which("git") is None:
        pytest.skip("needs a checkout of the repository")
    return Copy(tmp_path / "copy")


@pytest.fixture(scope="module")
def measured(tmp_path_factory) -> Path:
    """Positions of a virtual TX40, in the columns of the toolkit's own CSV files."""
    cell = planted.cell(planted.perturb(load("tx40"), 3), 1)
    block = planted.measure(cell, "position", 60, 5, sigma=1e-4)
    path = tmp_path_factory.mktemp("measured") / "measured.csv"
    rows = np.column_stack([block.q, block.position])
    np.savetxt(path, rows, delimiter=",", header="q1,q2,q3,q4,q5,q6,x,y,z", comments="")
    return path


def recipe(title: str) -> str:
    """Return the text of a recipe, or of the first change, in CONTRIBUTING."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    if title == "finding":
        return text.split("## Terms")[0]
    section = text.split("## How to add")[1].split("\n## ")[0]
    entries = re.split(r"\n\* ", section)
    (entry,) = [entry for entry in entries if entry.startswith(f"**{title}**")]
    return entry


NAMED_IN_WORDS = {
    # where it is noticed is for the author to say
    f"{STAGE}/verdict/plausibility.py": "Where it is noticed",
    f"{STAGE}/settings.py": "`FitSettings`",
    "calib/data/poses/fit_options.py": "`fit_options.FORMATS`",
}
RECIPES = {"finding": FINDING, "an option": OPTION, "an effect of the geometry": EFFECT, "a file format": FORMAT}


@pytest.mark.parametrize("title", RECIPES)
def test_edits_stand_in_their_files(title: str) -> None:
    """Each text that a recipe's step replaces stands once in the file that the recipe names."""
    for edit in RECIPES[title]:
        assert edit.replaced_in(ROOT)


@pytest.mark.parametrize("title", RECIPES)
def test_recipe_names_files_that_change(title: str) -> None:
    """A recipe names the files that change."""
    text = " ".join(recipe(title).split())
    changed = {edit.path for edit in RECIPES[title]}
    assert len(changed) <= 2
    for path in changed:
        assert path in text or NAMED_IN_WORDS.get(path, path) in text, f"{title}: {path} is not named"


@pytest.mark.slow
def test_a_finding(scratch: Copy, measured: Path) -> None:
    scratch.apply(FINDING)
    out = scratch.folder / "out"
    console = scratch.calib("fit", "tx40", str(measured), "--model", "geometry", "--out", str(out), "--no-plots")
    assert "moved by 0.498° only; measure again with that joint over a larger range" in console
    assert "joint-hardly-moved" in (out / "metrics.json").read_text(encoding="utf-8")
    assert "moved by 90° only" in scratch.calib("explain", "joint-hardly-moved")
    scratch.holds("tests/procedure/test_findings.py")


@pytest.mark.slow
def test_an_option(scratch: Copy, measured: Path) -> None:
    scratch.apply(OPTION)
    assert re.search(r"--fewest-poses \w+ +smallest number of poses", scratch.calib("fit", "--help"))
    refusal = scratch.calib("fit", "tx40", str(measured), "--fewest-poses", "2", "--out", "out", code=2)
    assert "from 3 to 500" in refusal
    scratch.holds("tests/procedure/test_formats_command.py", "tests/test_architecture.py")


@pytest.mark.slow
def test_an_effect_of_the_geometry(scratch: Copy, measured: Path) -> None:
    scratch.apply(EFFECT)
    out = scratch.folder / "out"
    scratch.calib("fit", "tx40", str(measured), "--model", "ratio", "--out", str(out), "--no-plots")
    metrics = json.loads((out / "metrics.json").read_text(encoding="utf-8"))
    assert "+ ratio" in [step["model"] for step in metrics["ladder"]]
    assert "harmonics, wobble, ratio" in scratch.calib("formats", "options")
    session = re.sub(r"\s+#?\s*", " ", scratch.calib("formats", "session"))
    assert "harmonics, wobble, ratio" in session
    scratch.holds("tests/test_architecture.py")


@pytest.mark.slow
def test_a_file_format(scratch: Copy, measured: Path) -> None:
    scratch.apply(FORMAT)
    rows = np.loadtxt(measured, delimiter=",", skiprows=1)
    rows = np.column_stack([np.degrees(rows[:, :6]), 1e3 * rows[:, 6:]])
    path = scratch.folder / "acme.csv"
    np.savetxt(path, rows, delimiter=",", header="A1,A2,A3,A4,A5,A6,X,Y,Z", comments="")
    out = scratch.folder / "out"
    console = scratch.calib("fit", "tx40", str(path), "--model", "geometry", "--out", str(out), "--no-plots")
    assert "read as a table of ACME" in console
    assert "csv, robodk, three_smr, acme" in scratch.calib("formats", "options")
    scratch.holds("tests/test_config.py", "-k", "schema")
