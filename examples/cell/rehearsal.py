"""Three arms from `calib new` to a delivered correction, every step a command, every file as an engineer gets it.

    python examples/cell/rehearsal.py --out rehearsal

A simulated robot with hidden errors takes the place of the arm and of the tracker: it plays the program that `calib`
wrote, read here by other rules than `calib`'s own, and leaves the controller's and the instrument's files. What came
out is compared with the hidden truth, by Pinocchio where it is a robot; the folder's README.md is the table.
"""

import argparse
import ast
import csv
import io
import json
import re
from collections.abc import Callable
from contextlib import chdir, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from calib import cli
from calib.robot.kinematics import forward
from calib.simulation.cell import SimulatedInstrument, measure, true_poses
from calib.simulation.virtual_cells import virtual_cell

HERE = Path(__file__).parent
TRACKER = SimulatedInstrument("laser tracker", 20e-6, None)
POSES, UNSEEN, MISSED, SEED = 40, 20, 3, 7
SETS = {"poses": "measured", "validation_poses": "validation_measured"}


def calib(*words: object, folder: Path) -> str:
    """Type a command; return what it printed. Every command stands in ``commands.txt``.

    It runs in this process: the start of a process would take longer than most of the commands.
    """
    line, out, err = [*map(str, words)], io.StringIO(), io.StringIO()
    with (folder / "commands.txt").open("a") as log:
        print("calib", *line, file=log)
    with chdir(folder), redirect_stdout(out), redirect_stderr(err):
        code = cli.run(line)
    if code:
        raise SystemExit(f"calib {' '.join(line)}\n{out.getvalue()}{err.getvalue()}")
    return out.getvalue()


# ---- What the controller does with a program, and the file of joints that it leaves ----------------------------------


def ur_script(program: Path) -> np.ndarray:
    """Return the joints [rad] that a URScript moves to."""
    return np.array([ast.literal_eval(text) for text in re.findall(r"movej\((\[.*?\])", program.read_text())])


def ur_log(q: np.ndarray, path: Path) -> None:
    """Write PolyScope's log with the joints that the program read."""
    rows = (
        f"2026-11-27 08:{k:02}:07 RTMachine: calib {k} {[round(v, 6) for v in row]}\n"
        for k, row in enumerate(q.tolist(), 1)
    )
    path.write_text("".join(rows))


def tp_program(program: Path) -> np.ndarray:
    """Return the description's joints [rad] of a TP program: a FANUC's J3 counts from the horizontal."""
    shown = np.array(re.findall(r"J\d=\s*(\S+) deg", program.read_text()), dtype=float).reshape(-1, 6)
    shown[:, 2] += shown[:, 1]
    return np.radians(shown)


def posreg(q: np.ndarray, path: Path) -> None:
    """Write a FANUC's position registers, as a backup holds them."""
    shown = np.degrees(q)
    shown[:, 2] -= shown[:, 1]
    lines = [f"[*POSREG*]$POSREG  Storage: CMOS  Access: RW  : ARRAY[1,{len(q) + 1}] OF Position Reg"]
    for k, row in enumerate(shown, 1):
        three = ["   ".join(f"J{j + 1} = {row[j]:9.3f} deg" for j in part) for part in ((0, 1, 2), (3, 4, 5))]
        lines += [f"    [1,{k}] =   ''   Group: 1", *(f"  {text} " for text in three), ""]
    path.write_text("\n".join([*lines, f"    [1,{len(q) + 1}] =   '' Uninitialized", ""]))


def ros_node(program: Path) -> np.ndarray:
    """Return the joints [rad] in the list POSES of a Python node."""
    parts = [each for each in ast.parse(program.read_text()).body if isinstance(each, ast.Assign)]
    return np.array(next(ast.literal_eval(one.value) for one in parts if ast.unparse(one.targets[0]) == "POSES"))


def node_csv(q: np.ndarray, path: Path) -> None:
    """Write the CSV of joint states that the node leaves."""
    header = ",".join(["pose", *(f"joint{k + 1} [rad]" for k in range(q.shape[1]))])
    rows = np.column_stack([np.arange(1, len(q) + 1), q])
    np.savetxt(path, rows, ["%d", *["%.9f"] * q.shape[1]], ",", header=header, comments="")


# ---- What the instrument writes: other order, poses that were not seen, decimal commas, inches -----------------------


def spatial_analyzer(points: np.ndarray, order: np.ndarray, path: Path) -> None:
    """Write SpatialAnalyzer's point list with decimal commas [mm]."""
    rows = (
        "\t".join(["Cell", "Arm", f"P{k + 1}", *(f"{1e3 * v:.4f}".replace(".", ",") for v in points[k])]) for k in order
    )
    path.write_text("// New River Kinematics\n// Units: millimeters\n" + "\n".join(rows) + "\n")


def inches(points: np.ndarray, order: np.ndarray, path: Path) -> None:
    """Write a spreadsheet's text in inches, decimal commas, without names."""
    rows = (";".join(f"{v / 0.0254:.6f}".replace(".", ",") for v in points[k]) for k in order)
    path.write_text("Units: inches\nX;Y;Z\n" + "\n".join(rows) + "\n")


# ---- The part program that is to be corrected -----------------------------------------------------------------------


def ur_part(q: np.ndarray) -> str:
    """Return a part program of a UR."""
    moves = "".join(f"  movej({[round(v, 9) for v in row]}, a=1.2, v=0.5)  # taught\n" for row in q.tolist())
    return f"def part():\n  set_digital_out(0, True)\n{moves}end\n"


def tp_part(q: np.ndarray) -> str:
    """Return a part program of a FANUC."""
    shown = np.degrees(q)
    shown[:, 2] -= shown[:, 1]
    moves = "".join(f"{k:4d}:J P[{k}] 50% FINE ;\n" for k in range(1, len(q) + 1))
    places = ""
    for k, row in enumerate(shown, 1):
        three = [",\t".join(f"J{j + 1}= {row[j]:9.3f} deg" for j in part) for part in ((0, 1, 2), (3, 4, 5))]
        places += f"P[{k}]{{\n   GP1:\n\tUF : 0, UT : 1,\t\n\t{three[0]},\n\t{three[1]}\n}};\n"
    return f"/PROG  PART\n/ATTR\nLINE_COUNT\t= {len(q)};\n/MN\n{moves}/POS\n{places}/END\n"


def csv_part(q: np.ndarray) -> str:
    """Return targets of a planner as CSV."""
    rows = [",".join(f"{v:.9f}" for v in row) for row in q]
    return "\n".join([",".join(f"joint{k + 1} [rad]" for k in range(q.shape[1])), *rows, ""])


def csv_targets(path: Path) -> np.ndarray:
    """Return the joints [rad] in the table that `calib compensate` wrote; a target that is not reached is NaN."""
    with path.open() as file:
        rows = [*csv.reader(line for line in file if not line.startswith("#"))]
    joints = [k for k, name in enumerate(rows[0]) if name.startswith("joint")]
    unit = np.pi / 180 if "[deg]" in rows[0][joints[0]] else 1.0
    return unit * np.array([[float(row[k] or "nan") for k in joints] for row in rows[1:]])


@dataclass(frozen=True)
class Arm:
    """An arm with its controller: how its program is read, what files controller and instrument leave."""

    robot: str
    controller: str
    program: str
    plays: Callable[[Path], np.ndarray]
    log: str
    logs: Callable[[np.ndarray, Path], None]
    exports: Callable[[np.ndarray, np.ndarray, Path], None]
    part: str
    parts: Callable[[np.ndarray], str]
    sent: Callable[[Path], np.ndarray]
    checked: str


ARMS = {
    "ur5": Arm("ur5", "ur", ".script", ur_script, "{}_log.script", ur_log, spatial_analyzer,
               "part.script", ur_part, ur_script, "programs: Python's literals"),
    "lrmate200id": Arm(str(HERE / "lrmate200id.urdf"), "fanuc", ".ls", tp_program, "{}_POSREG.VA", posreg,
                       spatial_analyzer, "part.ls", tp_part, tp_program, "programs: the sums of fanuc_driver, by hand"),
    "lwr4plus": Arm("lwr4plus", "ros2", ".py", ros_node, "{}_joints.csv", node_csv, inches,
                    "part.csv", csv_part, csv_targets, "programs: Python's own parser (ast)"),
}  # fmt: skip


def played(name: str, folder: Path) -> tuple[str, ...]:
    """Play one arm in a folder; return its row of the table."""
    arm, session = ARMS[name], folder / "cell"
    cell = virtual_cell(arm.robot, SEED, TRACKER)
    told = ("--robot", arm.robot, "--instrument", "tracker", "--program", arm.controller, "--geometry-only")
    calib("new", "cell", *told, "--poses", POSES, "--validation", UNSEEN, "--seed", SEED, folder=folder)
    calib("next", "cell", "--no-plots", folder=folder)
    rng = np.random.default_rng(SEED)
    for planned, brought in SETS.items():
        found = measure(cell, arm.plays(session / f"2-poses/{planned}{arm.program}"), SEED)
        order = rng.permutation(len(found))[: -MISSED if planned == "poses" else None]
        joints, points = arm.log.format(planned), f"{planned}_points.txt"
        arm.logs(found.q, folder / joints)
        arm.exports(found.position, order, folder / points)
        calib("join", joints, points, "--robot", arm.robot, "--out", f"cell/3-measured/{brought}.csv", folder=folder)
    calib("next", "cell", "--no-plots", folder=folder)
    (folder / "delivered.txt").write_text(calib("deliver", "cell", "--for", arm.controller, folder=folder))
    seen = measure(cell, arm.plays(session / f"2-poses/validation_poses{arm.program}"), SEED).q
    (folder / arm.part).write_text(arm.parts(seen))
    sent = f"sent{Path(arm.part).suffix}"
    calib("compensate", "cell", arm.part, "--frame", "nominal", "--partial", "--out", sent, folder=folder)
    wanted = forward(cell.nominal, seen)
    verdict = json.loads((session / "verdict.json").read_text())
    commands = arm.sent(folder / sent)
    commands = np.where(np.isnan(commands), seen, commands)
    true, moved = true_poses(cell, seen), true_poses(cell, commands)
    delivered = urdf_poses(session / "6-export/robot.urdf", seen)
    errors = (misfit(wanted, true), misfit(delivered, true), misfit(wanted, moved))
    return (name, arm.controller, verdict["verdict"], *(f"{each:.2f}" for each in errors), arm.checked)


def urdf_poses(path: Path, q: np.ndarray) -> np.ndarray:
    """Return the last joint's poses (m, 4, 4) [m] of a URDF, by Pinocchio."""
    model = pinocchio.buildModelFromUrdf(str(path))
    data, found = model.createData(), []
    for row in q:
        pinocchio.forwardKinematics(model, data, row)
        found.append(data.oMi[model.njoints - 1].homogeneous)
    return np.array(found)


def misfit(arm: np.ndarray, true: np.ndarray) -> float:
    """Return the rms distance [mm] of an arm's poses from true ones, instrument and target best placed."""

    def apart(x: np.ndarray) -> np.ndarray:
        tool = arm[:, :3, :3] @ x[6:] + arm[:, :3, 3]
        return 1e3 * (Rotation.from_rotvec(x[:3]).apply(tool) + x[3:6] - true[:, :3, 3]).ravel()

    found = min(
        (least_squares(apart, [*turn, *np.zeros(6)]) for turn in np.vstack([np.eye(3), -np.eye(3)])),
        key=lambda one: one.cost,
    )
    return float(np.sqrt(2.0 * found.cost / len(arm)))


HEADS = ("arm", "controller", "verdict", "nominal", "URDF delivered", "program sent", "checked by")
ABOUT = """# Rehearsal of three arms

Made by `python examples/cell/rehearsal.py`; the commands are in each arm's `commands.txt`. Errors [mm rms] are against
the hidden truth at poses that no fit has seen, instrument and target placed best: of the nominal arm, of `robot.urdf`
read by Pinocchio, and of the part program after `calib compensate` (targets that are not reached stay as they are). The
script wrote the files of joints and points.

"""


def main(arms: list[str], out: Path) -> None:
    """Play the arms; print the table and write it to README.md."""
    rows = [HEADS, ("---",) * len(HEADS)]
    for name in arms:
        (out / name).mkdir(parents=True)
        rows.append(played(name, out / name))
    table = "\n".join(f"| {' | '.join(row)} |" for row in rows)
    (out / "README.md").write_text(f"{ABOUT}{table}\n")
    print(table)


if __name__ == "__main__":
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("arms", nargs="*", default=[*ARMS], help=", ".join(ARMS))
    options.add_argument("--out", type=Path, default=Path("rehearsal"))
    main(*vars(options.parse_args()).values())
