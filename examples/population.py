"""Calibrate a population of arms with planted errors by the defaults, and hold what is exported against the truth.

    python examples/population.py ../shared/data/public_arms --jobs 2 --csv population.csv
    python examples/population.py ../shared/data/cases/37_short_levers

Of each description every joint origin is moved (0.5 mm, 1 mrad about each axis), a target is mounted somewhere on the
flange and an instrument stands somewhere in the room. It measures the target in 60 postures, drawn evenly within the
joint limits, with 0.02 mm of noise. `calib.fit_geometry` sees those points and the nominal description; `calib.export`
writes the calibrated one. Pinocchio reads it (yourdfpy where Pinocchio does not), and places the target in 200 unseen
postures by the fit's station and tool; nothing is aligned. The error is to that truth, rms [mm]:

* *exported*: the tool hangs at the link where the fit ends,
* *in tool0*: it hangs at `tool0` (else `flange`), as it would be typed into a controller.

Classes: *noise level* (both errors up to 0.03 mm), *above* (*exported* is larger), *wrong frame* (only *in tool0* is),
*fail* (the verdict), *error* (no result).
"""

import argparse
import csv
import tempfile
import warnings
import zlib
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
from planted_arms import Arm, target_link
from scipy.spatial.transform import Rotation

import calib

UNSEEN = 200  # postures in which the exported robot is held against the truth
NOISE_LEVEL = 1.5  # times the instrument's σ: errors up to that are of the noise (0.03 mm of 0.02 mm)
CLASSES = ("noise level", "above", "wrong frame", "fail", "error")


@dataclass(frozen=True)
class Conditions:
    """What is measured: number of postures, σ of each coordinate [m], seed."""

    poses: int = 60
    noise: float = 0.02e-3
    seed: int = 0


@dataclass(frozen=True)
class Row:
    """Result of an arm: errors [mm] of the nominal and of the exported arm, links where fit and target end."""

    arm: str
    group: str
    verdict: str = ""
    model: str = ""
    tip: str = ""
    target_link: str = ""
    nominal_mm: float = np.nan
    exported_mm: float = np.nan
    in_tool0_mm: float = np.nan
    remark: str = ""


def rms_mm(errors: np.ndarray) -> float:
    """Return the rms [mm] of the norms of position errors (m, 3) [m]."""
    return 1e3 * float(np.sqrt((errors**2).sum(axis=1).mean()))


def write_measured(path: Path, arm: Arm, q: np.ndarray, points: np.ndarray) -> None:
    """Write joint values (m, n) and points (m, 3) [m] as an instrument's file."""
    header = []
    for joint in arm.movable:
        unit = "m" if joint.get("type") == "prismatic" else "rad"
        header.append(f"{joint.get('name', '')} [{unit}]")
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow([*header, "x [mm]", "y [mm]", "z [mm]"])
        for values, point in zip(q, points, strict=True):
            joints = [f"{value:.9f}" for value in values]
            position_mm = [f"{1e3 * value:.6f}" for value in point]
            table.writerow(joints + position_mm)


def calibrate(source: Path, conditions: Conditions, folder: Path) -> Row:
    """Plant errors in an arm, measure, fit, export and hold the export against the truth."""
    rng = np.random.default_rng([conditions.seed, zlib.crc32(source.stem.encode())])
    text = source.read_text(encoding="utf-8")
    chain = calib.load(source).chain
    nominal = Arm(text, chain.base, target_link(text, chain.base, chain.tip))
    truth = nominal.with_errors(rng)
    target = rng.uniform(-0.1, 0.1, 3)
    station = Rotation.from_quat(rng.normal(size=4))  # evenly distributed rotations
    stand = rng.uniform(-3.0, 3.0, 3)

    q = nominal.postures(conditions.poses, rng)
    points = station.apply(truth.positions(q, target)) + stand
    measured = folder / "measured.csv"
    write_measured(measured, nominal, q, points + rng.normal(0.0, conditions.noise, points.shape))
    fit = calib.fit_geometry(source, measured)
    calib.export(fit, folder / "exported", urdf=source)
    exported = (folder / "exported/robot.urdf").read_text(encoding="utf-8")

    # frames that belong to the rigid geometry, which is the one in the URDF
    unseen = nominal.postures(UNSEEN, rng)
    true_points = station.apply(truth.positions(unseen, target)) + stand
    rigid = fit.selection.rigid.cell
    before = fit.selection.nominal.cell
    errors = []
    for robot, cell, tip in (
        (text, before, chain.tip),
        (exported, rigid, rigid.chain.tip),
        (exported, rigid, nominal.tip),
    ):
        T_station_base = cell.stations[0]
        in_base = Arm(robot, cell.chain.base, tip).positions(unseen, cell.tools[0][:3, 3])
        in_station = in_base @ T_station_base[:3, :3].T + T_station_base[:3, 3]
        errors.append(rms_mm(in_station - true_points))

    level = fit.verdict.level
    group = classified(level, *errors[1:], limit=1e3 * NOISE_LEVEL * conditions.noise)
    return Row(source.stem, group, level, fit.selection.chosen, rigid.chain.tip, nominal.tip, *errors)


def classified(level: str, exported: float, in_tool0: float, limit: float) -> str:
    """Return the class of an arm by its verdict and its errors [mm]."""
    if level == "fail":
        return "fail"
    if exported > limit:
        return "above"
    if in_tool0 > limit:
        return "wrong frame"
    return "noise level"


def calibrate_safely(source: Path, conditions: Conditions) -> Row:
    """Return the row of an arm; an error is a result, too."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return calibrate(source, conditions, Path(folder))
        except Exception as error:
            message = " ".join(str(error).split())
            return Row(source.stem, "error", remark=f"{type(error).__name__}: {message[:200]}")


def descriptions(paths: Sequence[Path]) -> list[Path]:
    """Return the URDF files of folders and files."""
    files: list[Path] = []
    for path in paths:
        if path.is_dir():
            files += sorted(path.glob("*.urdf"))
        else:
            files.append(path)
    return files


def line(row: Row) -> str:
    """Return the result of an arm as a line of the console."""
    if row.group == "error":
        return f"{row.arm:42} error: {row.remark}"
    errors = f"{row.nominal_mm:7.3f} -> {row.exported_mm:8.4f} mm, in {row.target_link} {row.in_tool0_mm:8.4f} mm"
    return f"{row.arm:42} {row.group:12} {row.verdict:8} {errors}, {row.model}"


def print_table(rows: Sequence[Row]) -> None:
    """Print how many arms are in each class, with median and largest errors."""
    print(f"\n{'class':12} arms  exported: median, max [mm]   in tool0: median, max [mm]")
    for group in CLASSES:
        members = [row for row in rows if row.group == group]
        figures = ""
        if members and group != "error":
            exported = np.array([row.exported_mm for row in members])
            in_tool0 = np.array([row.in_tool0_mm for row in members])
            figures = f"{np.median(exported):16.4f} {exported.max():9.4f} "
            figures += f"{np.median(in_tool0):18.4f} {in_tool0.max():9.4f}"
        print(f"{group:12} {len(members):4} {figures}")
    fitted = [row for row in rows if row.group != "error"]
    at_target = [row for row in fitted if row.tip == row.target_link]
    print(f"fit ends where the target hangs: {len(at_target)} of {len(fitted)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("arms", nargs="+", type=Path, help="URDF files, or folders of them")
    parser.add_argument("--poses", type=int, default=60, help="measured postures")
    parser.add_argument("--noise", type=float, default=0.02, help="σ of each measured coordinate [mm]")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--csv", type=Path, help="file for the rows")
    options = parser.parse_args()
    conditions = Conditions(options.poses, 1e-3 * options.noise, options.seed)

    files = descriptions(options.arms)
    rows: list[Row] = []
    with ProcessPoolExecutor(options.jobs) as pool:
        for row in pool.map(calibrate_safely, files, [conditions] * len(files)):
            rows.append(row)
            print(f"{len(rows):3}/{len(files)} {line(row)}", flush=True)
    print_table(rows)
    if options.csv:
        with options.csv.open("w", newline="", encoding="utf-8") as file:
            table = csv.DictWriter(file, [field.name for field in fields(Row)])
            table.writeheader()
            table.writerows(asdict(row) for row in rows)


if __name__ == "__main__":
    main()
