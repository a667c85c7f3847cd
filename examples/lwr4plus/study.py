"""The whole reproduction of Kolyubin, Shiriaev & Jubien (2019, IJAMT 101): their tables beside ours.

Runs the scripts beside this one, each into a folder of its own; one that is there already is not run again, so that
an interrupted study goes on where it stopped. Every number of the last page is read back from their metrics.json.

    python examples/lwr4plus/study.py --out lwr4plus-study [--quick] [--only geometry dynamics …]
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from calib import files

HERE = Path(__file__).parent
PARTS: dict[str, tuple[list[str], list[str]]] = {  # options of the whole part, and of the quick one
    "geometry": ([], ["--quick"]),
    "dynamics": ([], ["--quick"]),
    "consistency": (["--runs", "500"], ["--runs", "0"]),
    "excitation": (["--full"], []),
    "planning": ([], ["--paths", "3"]),
}
FIG_8 = "paper: joint 6 within 0.5 N m, about 1 %"


def run(name: str, out: Path, quick: bool) -> float | None:
    """Run one part unless its metrics are there; return its seconds, None where it was there."""
    if (out / "metrics.json").exists():
        return None
    started = time.perf_counter()
    command = [sys.executable, str(HERE / f"{name}.py"), "--out", str(out), *PARTS[name][quick]]
    print(f"\n== {name}: {' '.join(command[1:])}", flush=True)
    subprocess.run(command, check=True)
    return time.perf_counter() - started


def geometry(found: dict[str, Any]) -> list[str]:
    """Return Tables 2 and 3."""
    lines = ["Table 2: frames 0 to 8 [m, rad]"]
    lines += [f"{'':10}{'nominal':>12}{'paper':>12}{'ours':>12}{'sigma':>10}{'off':>7}"]
    lines += [
        f"{row['name']:10}{row['nominal']:12.5f}{row['table_2']:12.5f}{row['estimate']:12.5f}{row['sigma']:10.1e}"
        f"{row['off_by_sigmas']:7.1f}"
        for row in found["table_2"]["parameters"]
    ]
    table = found["table_3"]
    rows = {f"paper, {name}": row for name, row in table["paper"].items()}
    rows |= {f"ours, nominal, {name}": row for name, row in table["nominal"].items()}
    rows |= {f"ours, {name}": row for name, row in table.items() if name.startswith("calibrated")}
    lines += ["", f"{'Table 3: mean / max':52}{'position [mm]':>16}{'orientation [deg]':>20}"]
    for name, row in rows.items():
        at, turn = row["position_mm"], row["orientation_deg"]
        lines.append(f"{name:52}{at['mean']:8.2f}{at['max']:8.2f}{turn['mean']:12.3f}{turn['max']:8.3f}")
    return lines


def dynamics(found: dict[str, Any]) -> list[str]:
    """Return the counts, Table 4 and Fig. 8."""
    lines = [f"{'base parameters':20}{'paper':>8}{'ours':>8}"]
    lines += [f"{name:20}{count:8}{found['counts'][name]:8}" for name, count in found["counts_asked"].items()]
    essential = found["essential"]
    listed = len(essential["both"]) + len(essential["only_table_4"])
    lines += [
        "",
        f"Table 4, essential parameters: paper {listed}, ours {essential['count']}, in both {len(essential['both'])}",
        f"  only in the paper: {' '.join(essential['only_table_4']) or 'none'}",
        f"  only here: {' '.join(essential['only_here']) or 'none'}",
        "",
        "values of another unit (Jubien, Gautier & Janot 2014) beside ours: parameter, theirs, ours, apart",
    ]
    lines += [
        f"  {name:12}{one['published']:9.4f}{one['here']:9.4f}{one['apart_percent']:6.0f} %"
        for name, one in found["published"].items()
    ]
    lines += ["", f"Fig. 8, computed torque on other motion, largest error per joint [N m] ({FIG_8})"]
    for geometry, parts in found["computed_torque"].items():
        for part, errors in parts.items():
            lines.append(f"  {geometry:11} {part:14} " + " ".join(f"{x:6.3f}" for x in errors["largest"]))
    return lines


def consistency(found: dict[str, Any]) -> list[str]:
    """Return Fig. 7 in numbers, and the coverage of the intervals."""
    lines = ["Fig. 7, identified on other geometries: torque error on unseen motion, bias in sigmas (rms, beyond 2)"]
    for name, one in found["geometries"].items():
        bias = one["bias_in_sigma"]
        error = one["torque_error_percent"]
        lines.append(f"  {name:45}{error:8.3f} %{bias['rms']:8.2f}{bias['beyond_2']:4}")
    for name, one in found["coverage"].items():
        over, every = one["geometry_exceeds_torque"], one["pooled"]
        lines.append(
            f"  {name}, {one['runs']} calibrations: 95 % intervals cover {every['with']:.1%} with the geometry's part, "
            f"{every['without']:.1%} without; {len(over['parameters'])} parameters where it exceeds the torque's"
        )
    return lines


def excitation(found: dict[str, Any]) -> list[str]:
    """Return the motions of Figs. 5 and 6 side by side."""
    lines = [
        "Figs. 5 and 6 (plot_paths.png, plot_estimates.png): trajectories and what they tell",
        f"  {'motion':28}{'cond raw':>10}{'norm.':>8}{'|tau6|':>8}{'|tau7|':>8}{'RSD %':>8}{'wrist':>8}",
    ]
    for name, row in found["motions"].items():
        cond, share = row["condition_number"], row["torque_share"]
        lines.append(
            f"  {name:28}{cond['raw']:10.1f}{cond['normalised']:8.2f}{share[5]:8.3f}{share[6]:8.3f}"
            f"{row['median_rsd']:8.2f}{row['median_rsd_wrist']:8.2f}"
        )
    return lines


def planning(found: dict[str, Any]) -> list[str]:
    """Return section 5: plans on several models, judged by the true robot."""
    lines = [f"Section 5, time-optimal plans: {'median s':>9}{'true peak':>11}{'active':>9}"]
    for name, one in found["summary"].items():
        lines.append(f"  {name:28}{one['seconds']:9.3f}{one['peak']:11.1%}{one['active']:9.1%}")
    return lines


SHOW: dict[str, Callable[[dict[str, Any]], list[str]]] = {
    "geometry": geometry, "dynamics": dynamics, "consistency": consistency, "excitation": excitation,
    "planning": planning,
}  # fmt: skip


def main() -> None:
    """Run what is missing, then print the tables and write them to study.txt."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--quick", action="store_true", help="each part in its short form: to see that it runs")
    parser.add_argument("--only", nargs="+", choices=list(PARTS), default=list(PARTS))
    given = parser.parse_args()
    lines = ["quick form: these are not the study's figures"] if given.quick else []
    for name in given.only:
        seconds = run(name, given.out / name, given.quick)
        found = json.loads((given.out / name / "metrics.json").read_text(encoding="utf-8"))
        lines += ["", f"== {name}" + ("" if seconds is None else f" ({seconds:.0f} s)"), *SHOW[name](found)]
    text = "\n".join(lines) + "\n"
    files.write(given.out / "study.txt", text)
    print(text)


if __name__ == "__main__":
    main()
