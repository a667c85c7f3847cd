"""A plain fit beside the toolkit's on open recordings of geometry: rms position error [mm] on held-out rows.

    CALIB_DATA=../shared/data python examples/plain_references.py --only iiwa7 --csv references.csv
    python examples/plain_references.py --list

* *nominal*: station and targets fitted, joint origins nominal,
* *plain*: `plain_map.py`, Pinocchio and SciPy alone: all joint origins with a prior of making, nothing selected,
* *URDF*: what `calib.export` writes of a `calib.fit_geometry` by the defaults, read by Pinocchio,
* *corrections*: the same fit with its joint corrections, by the toolkit's figures.

All of them see the same rows and are judged on the same other ones. Where those are of another day (→), station and
targets are fitted to them for each.
"""

import argparse
import csv
import os
import tempfile
import time
import warnings
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path

import numpy as np
import plain_map
from plain_map import Cell, Chain, Targets
from planted_arms import Arm
from scipy.spatial.transform import Rotation

import calib

DATA = Path(os.environ.get("CALIB_DATA", "../shared/data"))
WORSE = 1.02  # ratio to the plain fit from which on a delivered URDF counts as worse


@dataclass(frozen=True)
class Recording:
    """Measured poses of an arm: one or several files of the same columns, below `DATA`.

    `targets` are columns x, y, z of each target, `orientation` those of a quaternion x y z w or of a matrix by rows.
    """

    robot: str
    files: tuple[str, ...]
    joints: tuple[str, ...]
    targets: tuple[tuple[str, str, str], ...]
    orientation: tuple[str, ...] = ()
    robust: bool = False  # a few rows are grossly off

    def lines(self) -> tuple[str, list[str]]:
        """Return the header and the rows of the files, as text."""
        header = ""
        rows: list[str] = []
        for name in self.files:
            lines = (DATA / name).read_text(encoding="utf-8").splitlines()
            header = lines[0]
            rows += [line for line in lines[1:] if line.strip()]
        return header, rows

    def read(self, header: str, rows: Sequence[str]) -> tuple[np.ndarray, Targets]:
        """Return joint values (m, n) [rad or m] and targets of rows of text; all files here are in m and rad."""
        names = [name.strip() for name in header.split(",")]
        table = np.array([row.split(",") for row in rows])

        def columns(chosen: Sequence[str]) -> np.ndarray:
            indices = [names.index(name) for name in chosen]
            return table[:, indices].astype(float)

        positions = np.stack([columns(target) for target in self.targets], axis=1)
        orientations = None
        if len(self.orientation) == 4:
            orientations = Rotation.from_quat(columns(self.orientation)).as_matrix()
        elif self.orientation:
            orientations = columns(self.orientation).reshape(-1, 3, 3)
        return columns(self.joints), Targets(positions, orientations)


@dataclass(frozen=True)
class Row:
    """A row of the table: what is fitted and what is held out, in `draws` random splits.

    Either `poses` rows (or the `share` of them) are drawn from `fitted` and the others are held out; or `unseen` is
    another recording, with its own station and targets where it is of `another_day`.
    """

    name: str
    fitted: Recording
    draws: int = 1
    poses: int = 0
    share: float = 0.0
    unseen: Recording | None = None
    another_day: bool = False


@dataclass(frozen=True)
class Result:
    """Errors [mm] of one split of a row, and the toolkit's verdict or error."""

    row: str
    draw: int
    fitted: int
    held_out: int
    nominal: float
    plain: float
    urdf: float = np.nan
    corrections: float = np.nan
    verdict: str = ""
    seconds: float = 0.0


def numbered(prefix: str, count: int) -> tuple[str, ...]:
    """Return the columns q1 … qn."""
    return tuple(f"{prefix}{number}" for number in range(1, count + 1))


MEASURED = (("x_meas", "y_meas", "z_meas"),)
XYZ = (("x", "y", "z"),)
QUATERNION = ("qx_meas", "qy_meas", "qz_meas", "qw_meas")
MATRIX = ("r11", "r12", "r13", "r21", "r22", "r23", "r31", "r32", "r33")
MOTOMAN = ("q_E_external", "q_S", "q_L", "q_U", "q_R", "q_B", "q_T")
TIAGO = ("torso_lift_joint", *(f"arm_{number}_joint" for number in range(1, 8)))

UR5 = Recording("ur5_gts3800/model.urdf", ("ur5_gts3800/grid_800.csv",), numbered("q", 6), MEASURED)
IIWA = numbered("q", 7)
IIWA_FOLDER = "kuka_iiwa7"
IIWA_ROBOT = f"{IIWA_FOLDER}/model.urdf"
IIWA_TRAIN = Recording(IIWA_ROBOT, (f"{IIWA_FOLDER}/train_positions.csv",), IIWA, XYZ)
IIWA_TEST = Recording(IIWA_ROBOT, (f"{IIWA_FOLDER}/test_positions.csv",), IIWA, XYZ)
IIWA_POSITIONS = Recording(IIWA_ROBOT, (*IIWA_TRAIN.files, *IIWA_TEST.files), IIWA, XYZ)
IIWA_POSES = Recording(IIWA_ROBOT, (f"{IIWA_FOLDER}/train.csv", f"{IIWA_FOLDER}/test.csv"), IIWA, XYZ, MATRIX)
MOTOMAN_SMALL = Recording("motoman_leica/model_right.urdf", ("motoman_leica/right_6x6x6_150.csv",), MOTOMAN, MEASURED)
MOTOMAN_WIDE = Recording("motoman_leica/model_right.urdf", ("motoman_leica/right_wide_386.csv",), MOTOMAN, MEASURED)
UR10_A = Recording("ur10_ipa/model.urdf", ("ur10_ipa/A_grid_2500.csv",), numbered("q", 6), MEASURED, QUATERNION)
UR10_B = Recording(
    "ur10_ipa/model.urdf", ("ur10_ipa/B_joint_configurations.csv",), numbered("q", 6), MEASURED, QUATERNION
)
TIAGO_MARKERS = Recording(
    "tiago_laas/model.urdf",
    ("tiago_laas/mocap_35poses.csv",),
    TIAGO,
    (("x1", "y1", "z1"), ("x2", "y2", "z2"), ("x3", "y3", "z3")),
    robust=True,
)
POSITIONER = Recording(
    "positioner_2axis/positioner.urdf",
    ("positioner_2axis/positioner.csv",),
    numbered("q", 2),
    XYZ,
    ("qx", "qy", "qz", "qw"),
)
ROWS = (
    Row("UR5, 15 poses", UR5, draws=20, poses=15),
    Row("UR5, 20 poses", UR5, draws=20, poses=20),
    Row("UR5, 40 poses", UR5, draws=20, poses=40),
    Row("UR5, 600 poses", UR5, share=0.25),
    Row("iiwa7, positions, its files", IIWA_TRAIN, unseen=IIWA_TEST),
    Row("iiwa7, positions", IIWA_POSITIONS, draws=10, poses=203),
    Row("iiwa7, full poses", IIWA_POSES, draws=10, poses=203),
    Row("Motoman, small", MOTOMAN_SMALL, draws=3, share=1 / 3),
    Row("Motoman, wide", MOTOMAN_WIDE, draws=3, share=0.25),
    Row("UR10 A", UR10_A, share=0.4),
    Row("UR10 A → B", UR10_A, unseen=UR10_B, another_day=True),
    Row("UR10 B → A", UR10_B, unseen=UR10_A, another_day=True),
    Row("TIAGo", TIAGO_MARKERS, draws=3, share=0.25),
    Row("positioner", POSITIONER, draws=5, share=0.25),
)


def rms_mm(cell: Cell, q: np.ndarray, measured: Targets) -> float:
    """Return the rms [mm] over rows and targets of the distances between predicted and measured targets."""
    errors = cell.positions(q) - measured.positions
    return 1e3 * float(np.sqrt((errors**2).sum(axis=2).mean()))


def split(row: Row, draw: int) -> tuple[str, list[str], str, list[str]]:
    """Return header and rows that are fitted, and header and rows that are held out, as text."""
    header, lines = row.fitted.lines()
    if row.unseen is not None:
        return header, lines, *row.unseen.lines()
    order = np.random.default_rng(draw).permutation(len(lines))
    count = row.poses or round(len(lines) * (1.0 - row.share))
    fitted = [lines[k] for k in order[:count]]
    held_out = [lines[k] for k in order[count:]]
    return header, fitted, header, held_out


def judge(cell: Cell, q: np.ndarray, measured: Targets, another_day: bool) -> float:
    """Return the error [mm] of a cell on held-out rows, station and targets fitted to them if of another day."""
    if another_day:
        cell = plain_map.with_frames(cell, q, measured)
    return rms_mm(cell, q, measured)


def run(row: Row, draw: int, plain_only: bool = False) -> Result:
    """Fit the rows of a draw plainly and by the toolkit, and judge both on the others."""
    start = time.perf_counter()
    header, lines, unseen_header, unseen_lines = split(row, draw)
    q, measured = row.fitted.read(header, lines)
    unseen_q, unseen = (row.unseen or row.fitted).read(unseen_header, unseen_lines)

    robot = DATA / row.fitted.robot
    text = robot.read_text(encoding="utf-8")
    ends = calib.load(robot).chain  # of which base and tip alone are used
    nominal = plain_map.placed(Chain.of(Arm(text, ends.base, ends.tip)), q, measured)
    plain = plain_map.fit(nominal, q, measured, robust=row.fitted.robust)
    result = Result(
        row.name,
        draw,
        fitted=len(lines),
        held_out=len(unseen_lines),
        nominal=judge(nominal, unseen_q, unseen, row.another_day),
        plain=judge(plain, unseen_q, unseen, row.another_day),
    )
    if plain_only:
        return replace(result, seconds=time.perf_counter() - start)

    with tempfile.TemporaryDirectory() as temporary, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        folder = Path(temporary)
        fitted_file = write_rows(folder / "fitted.csv", header, lines)
        unseen_file = write_rows(folder / "unseen.csv", unseen_header, unseen_lines)
        settings = calib.FitSettings(refit_frames=row.another_day)
        try:
            fit = calib.fit_geometry(robot, fitted_file, settings, validate=unseen_file)
            calib.export(fit, folder / "exported", urdf=robot)
        except Exception as error:  # an error is a result, too
            message = " ".join(str(error).split())
            verdict = f"{type(error).__name__}: {message[:120]}"
            return replace(result, verdict=verdict, seconds=time.perf_counter() - start)
        exported = (folder / "exported/robot.urdf").read_text(encoding="utf-8")

    delivered = delivered_cell(fit, exported)
    (record,) = fit.to_dict()["validation"].values()
    return replace(
        result,
        urdf=judge(delivered, unseen_q, unseen, row.another_day),
        corrections=record["calibrated"]["position_mm"]["rms"],
        verdict=fit.verdict.level,
        seconds=time.perf_counter() - start,
    )


def write_rows(path: Path, header: str, lines: Sequence[str]) -> Path:
    """Write a file of measured poses; return its path."""
    path.write_text("\n".join([header, *lines, ""]), encoding="utf-8")
    return path


def delivered_cell(fit: calib.GeometryFit, exported: str) -> Cell:
    """Return the exported URDF as Pinocchio reads it, with the frames that belong to the rigid geometry."""
    rigid = fit.selection.rigid.cell
    chain = Chain.of(Arm(exported, rigid.chain.base, rigid.chain.tip))
    twists = np.zeros((1 + len(chain.origins) + len(rigid.tools), 6))
    return Cell(chain, rigid.stations[0], rigid.tools, twists)


def progress(result: Result) -> str:
    """Return the errors of a split as a line of the console."""
    errors = f"nominal {result.nominal:.4f}, plain {result.plain:.4f}"
    if np.isfinite(result.urdf):
        errors += f", URDF {result.urdf:.4f}, corrections {result.corrections:.4f}"
    return f"{result.row:28} draw {result.draw:2}: {errors} mm  {result.verdict} ({result.seconds:.0f} s)"


def print_table(results: Sequence[Result]) -> None:
    """Print a line per row: median and largest error over its draws, and how many URDFs are worse than the plain."""
    columns = ("nominal", "plain", "urdf", "corrections")
    titles = "".join(f"{title:>16}" for title in columns)
    print(f"\n{'rms on held-out rows [mm]':28} draws fitted{titles}   URDF / plain: largest, above {WORSE}")
    names = dict.fromkeys(result.row for result in results)
    for name in names:
        draws = [result for result in results if result.row == name]
        line = f"{name:28} {len(draws):5} {draws[0].fitted:6}"
        for column in columns:
            line += f"{median_and_largest(finite(getattr(result, column) for result in draws)):>16}"
        ratios = finite(result.urdf / result.plain for result in draws)
        if len(ratios):
            line += f"   {ratios.max():.3f}, {np.sum(ratios > WORSE)} of {len(ratios)}"
        print(line)
    print("median (largest) over the draws")


def finite(values: Iterable[float]) -> np.ndarray:
    """Return the values that are finite."""
    array = np.array(list(values))
    return array[np.isfinite(array)]


def median_and_largest(values: np.ndarray) -> str:
    """Return the median and the largest value as a cell."""
    if not len(values):
        return "none"
    return f"{np.median(values):.3f} ({values.max():.3f})"


def rows_named(texts: Sequence[str]) -> list[Row]:
    """Return the rows whose names contain one of the texts."""

    def matches(row: Row) -> bool:
        return any(text.lower() in row.name.lower() for text in texts)

    return [row for row in ROWS if matches(row)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=[""], help="rows whose names contain one of these")
    parser.add_argument("--draws", type=int, default=10**6, help="at most so many random splits of each row")
    parser.add_argument("--plain", action="store_true", help="no toolkit: nominal and plain alone")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--csv", type=Path, help="file for the errors of each split")
    parser.add_argument("--list", action="store_true", help="print the rows and stop")
    options = parser.parse_args()
    rows = rows_named(options.only)
    if options.list:
        print("\n".join(row.name for row in rows))
        return

    task_rows: list[Row] = []
    task_draws: list[int] = []
    for row in rows:
        draws = range(min(row.draws, options.draws))
        task_rows += [row] * len(draws)
        task_draws += draws
    results: list[Result] = []
    with ProcessPoolExecutor(options.jobs) as pool:
        for result in pool.map(partial(run, plain_only=options.plain), task_rows, task_draws):
            results.append(result)
            print(f"{len(results):3}/{len(task_rows)} {progress(result)}", flush=True)
    print_table(results)
    if options.csv:
        with options.csv.open("w", newline="", encoding="utf-8") as file:
            table = csv.DictWriter(file, [field.name for field in fields(Result)])
            table.writeheader()
            table.writerows(asdict(result) for result in results)


if __name__ == "__main__":
    main()
