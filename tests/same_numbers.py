"""Run some twenty real commands and compare what they leave with what another version left.

    python tests/same_numbers.py run FOLDER [NAME ...]      # runs the commands of this environment's calib
    python tests/same_numbers.py compare BEFORE AFTER       # prints what differs; exit code 1 where something does

Files are compared by their numbers, not by their layout: a JSON file holds the same numbers in any order and under any
key, a CSV file the same numbers column by column, a URDF the same numbers in order. Commands on open data are left out
where CALIB_DATA (default ../shared/data) is absent. Exit codes stand in codes.json.
"""

import csv
import json
import os
import re
import subprocess
import sys
from bisect import bisect_left
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import calib

DATA = Path(os.environ.get("CALIB_DATA", Path(__file__).resolve().parents[2] / "shared" / "data")).resolve()
RELATIVE, ABSOLUTE = 1e-9, 1e-12
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?(?![\w.])")
WAYPOINTS = "q1,q2,q3,q4,q5,q6\n0,-1.2,1.2,0,1,0\n1,-0.8,0.6,0.5,0.5,0.5\n-1,-1.5,1.5,0,1,1\n"
LIMITS = "[acceleration]\nall = 5.0\n"

UR5, UR10E = "{data}/ur5_gts3800", "{data}/ur10e_innopolis"
TX40, LWR = "{data}/staubli_tx40", "{data}/kuka_lwr4plus_iit"
COMMANDS = {  # name: (name of the one that must have run before, command line)
    "practice": (None, ""),
    "fit_sim": ("practice", "fit ur5 ../practice/measured.csv --holdout 0.25 --out out --no-plots"),
    "fit_ur5": (None, f"fit {UR5}/model.urdf {UR5}/grid_800.csv --holdout 0.25 --tolerance 0.1 --out out --no-plots"),
    "fit_ur10b": (None, "fit {data}/ur10_ipa/model.urdf {data}/ur10_ipa/B_joint_configurations.csv --holdout 0.25 "
                  "--model geometry --out out --no-plots"),
    "fit_motoman": (None, "fit {data}/motoman_leica/model_right.urdf {data}/motoman_leica/right_6x6x6_150.csv "
                    "--model stiffness --out out --no-plots"),
    "fit_tiago": (None, "fit {data}/tiago_laas/model.urdf {data}/tiago_laas/mocap_35poses.csv --out out --no-plots"),
    "select_ur5": (None, "select ur5 -m 20 --out poses.csv --no-plots"),
    "select_lwr": (None, "select lwr4plus -m 15 --kind position --tool 0.1,0,0.1 --method tabu --candidates 200 "
                   "--out poses.csv --no-plots"),
    "compensate": ("fit_sim", "compensate ../fit_sim/out ../practice/targets.csv --frame measured --tool tool "
                   "--out commands.csv"),
    "excite": (None, "excite tx40 --period 5 --starts 1 --evaluations 60 --no-outlook --out motion --no-plots"),
    "excite_dualv": (None, "excite dualv --period 2 --starts 1 --evaluations 60 --no-outlook --out motion --no-plots"),
    "plan": (None, "plan ur10e --waypoints waypoints.csv --limits limits.toml --out motion --no-plots"),
    "identify_tx40": (None, f"identify {TX40}/model.urdf {TX40}/tx40_first_5p4s.npz@0:4 --validate "
                      f"{TX40}/tx40_first_5p4s.npz@4:5.4 --out out --no-plots"),
    "identify_ur10e": (None, f"identify {UR10E}/model.urdf {UR10E}/ur-20_02_10-20sec_7harm.npz --validate "
                       f"{UR10E}/ur-20_02_06-20sec_5harm.npz --out out --no-plots"),
    "identify_lwr": (None, f"identify {LWR}/model.urdf {LWR}/measurements_1.npz@0:8 --friction standard --out out "
                     "--no-plots"),
    "identify_sim": ("practice", "identify tx40 ../practice/log1.csv --validate ../practice/log2.csv --out out "
                     "--no-plots"),
    "identify_iv": ("practice", "identify tx40 ../practice/log1.csv --method ols --friction standard --out out "
                    "--no-plots"),
    "compare": ("practice", "compare tx40 ../practice/log1.csv --validate ../practice/log2.csv "
                "--methods ols,wls,irls,tls --out table.csv"),
    "export_fit": ("fit_ur5", f"export ../fit_ur5/out --urdf {UR5}/model.urdf --into delivered"),
    "export_dyn": ("identify_lwr", f"export ../identify_lwr/out --urdf {LWR}/model.urdf --into delivered"),
    "study": (None, "study MCS-TX40-1-1 --methods ols,wls --runs 2 --out out --no-plots"),
    "demo": (None, "demo --out session"),
    "view_formats": (None, "formats options"),
}  # fmt: skip
PREPARE = """
import sys; sys.path.insert(0, {examples!r})
import practice
practice.measure("measured.csv"); practice.teach("targets.csv")
practice.record("log1.csv", 1); practice.record("log2.csv", 2)
"""


def run(folder: Path, names: list[str]) -> None:
    """Run the commands, two at a time, each in a folder of its own below folder."""
    examples = Path(calib.__file__).resolve().parents[1] / "examples"
    folder.mkdir(parents=True, exist_ok=True)
    kept = folder / "codes.json"
    codes: dict[str, int] = json.loads(kept.read_text()) if kept.exists() else {}

    def one(name: str) -> None:
        place = (folder / name).resolve()
        place.mkdir(parents=True, exist_ok=True)
        (place / "waypoints.csv").write_text(WAYPOINTS)
        (place / "limits.toml").write_text(LIMITS)
        line = COMMANDS[name][1].format(data=DATA)
        command = [sys.executable, "-c", PREPARE.format(examples=str(examples))] if name == "practice" else [
            sys.executable, "-m", "calib", *line.split()]  # fmt: skip
        with (place / "console.txt").open("w") as console:
            codes[name] = subprocess.run(command, cwd=place, stdout=console, stderr=subprocess.STDOUT).returncode
        print(name, codes[name], flush=True)

    chosen = [name for name in COMMANDS if not names or name in names]
    chosen = [name for name in chosen if DATA.is_dir() or "{data}" not in COMMANDS[name][1]]
    done: list[str] = []
    with ThreadPoolExecutor(2) as pool:
        while ready := [
            n for n in chosen if n not in done and (COMMANDS[n][0] in done or COMMANDS[n][0] not in chosen)
        ]:
            list(pool.map(one, ready))
            done += ready
    kept.write_text(json.dumps(codes, indent=1, sort_keys=True))


def numbers(value) -> list[float]:
    """Return all numbers of a JSON value."""
    if isinstance(value, dict):
        return [number for item in value.values() for number in numbers(item)]
    if isinstance(value, list):
        return [number for item in value for number in numbers(item)]
    return [float(value)] if isinstance(value, int | float) and not isinstance(value, bool) else []


def read(path: Path) -> dict[str, list[float]]:
    """Return the numbers of a file, by column for a CSV file, else under the empty name."""
    if path.suffix == ".json":
        return {"": numbers(json.loads(path.read_text()))}
    if path.suffix == ".csv":
        lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
        rows = list(csv.reader(lines))
        head, body = (rows[0], rows[1:]) if rows else ([], [])
        return {
            name: [float(t) for row in body for t in row[i : i + 1] if NUMBER.fullmatch(t)]
            for i, name in enumerate(head)
        }
    return {"": [float(text) for text in NUMBER.findall(path.read_text())]}


def missing(before: list[float], after: list[float], ordered: bool) -> list[tuple[float, float]]:
    """Return the numbers of before that after does not hold, each with the nearest (or the one in its place).

    In order, what counts is the largest of all (a column of sensitivities has entries of rounding error).
    """
    if ordered and len(before) == len(after):
        scale = max(map(abs, before), default=0.0)
        return [(one, two) for one, two in zip(before, after) if abs(one - two) > RELATIVE * scale + ABSOLUTE]
    known = sorted(after) or [float("inf")]
    nearest = []
    for number in before:
        place = bisect_left(known, number)
        nearest.append(min(known[max(place - 1, 0) : place + 1], key=lambda one: abs(one - number)))
    return [(one, two) for one, two in zip(before, nearest) if abs(one - two) > RELATIVE * abs(one) + ABSOLUTE]


def compare(before: Path, after: Path) -> int:
    """Print, per command, which files and numbers of before are not in after; return 1 where there are any."""
    faults = 0
    codes = [json.loads((folder / "codes.json").read_text()) for folder in (before, after)]
    for name, code in codes[0].items():
        if name not in codes[1]:
            continue
        said = [] if codes[1][name] == code else [f"exit code {code} became {codes[1][name]}"]
        for path in sorted((before / name).rglob("*")):
            if path.suffix not in (".json", ".csv", ".urdf", ".toml", ".yaml") or not (after / name).exists():
                continue
            inside = path.relative_to(before)
            if not (after / inside).exists():
                said.append(f"{inside} is missing")
                continue
            old, new = read(path), read(after / inside)
            for column, values in old.items():
                lost = missing(values, new.get(column, []), path.suffix != ".json")
                if lost:
                    said.append(f"{inside} {column}: {len(lost)} of {len(values)} numbers differ, e.g. {lost[:3]}")
        print(f"{name}: {'equal' if not said else ''}", *said, sep="\n  " if said else "")
        faults += len(said)
    return int(faults > 0)


if __name__ == "__main__":
    if sys.argv[1] == "run":
        run(Path(sys.argv[2]), sys.argv[3:])
    else:
        raise SystemExit(compare(Path(sys.argv[2]), Path(sys.argv[3])))
