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

import calib
from calib import cli
from calib.robot.kinematics import forward
from calib.simulation.cell import Cell, measure, true_poses
from calib.simulation.virtual_cells import virtual_cell

HERE = Path(__file__).parent
TRACKER = calib.SimulatedInstrument("laser tracker", 20e-6, None)
POSES = 40
VALIDATION = 20
HIDDEN = 3  # poses that the tracker did not see
SEED = 7
# planned poses → name of the measured file
SETS = {"poses": "measured", "validation_poses": "validation_measured"}


def command(*arguments: object, folder: Path) -> str:
    """Type a `calib` command; return what it printed. Every command stands in ``commands.txt``.

    It runs in this process: the start of a process would take longer than most of the commands.
    """
    command_line = [str(argument) for argument in arguments]
    with (folder / "commands.txt").open("a") as log:
        print("calib", *command_line, file=log)
    output = io.StringIO()
    errors = io.StringIO()
    with chdir(folder), redirect_stdout(output), redirect_stderr(errors):
        code = cli.run(command_line)
    if code:
        raise SystemExit(f"calib {' '.join(command_line)}\n{output.getvalue()}{errors.getvalue()}")
    return output.getvalue()


# ---- What the controller does with a program, and the file of joints that it leaves ----------------------------------


def ur_script(program: Path) -> np.ndarray:
    """Return the joints [rad] that a URScript moves to."""
    postures = re.findall(r"movej\((\[.*?\])", program.read_text())
    return np.array([ast.literal_eval(posture) for posture in postures])


def ur_log(q: np.ndarray, path: Path) -> None:
    """Write PolyScope's log with the joints that the program read."""
    lines = []
    for k, posture in enumerate(q.tolist(), 1):
        joints = [round(value, 6) for value in posture]
        lines.append(f"2026-11-27 08:{k:02}:07 RTMachine: calib {k} {joints}\n")
    path.write_text("".join(lines))


def fanuc_degrees(q: np.ndarray) -> np.ndarray:
    """Return joints [deg] as a FANUC shows them, of those [rad] in the description: J3 counts from the horizontal."""
    degrees = np.degrees(q)
    degrees[:, 2] -= degrees[:, 1]
    return degrees


def tp_program(program: Path) -> np.ndarray:
    """Return the description's joints [rad] of a TP program."""
    values = re.findall(r"J\d=\s*(\S+) deg", program.read_text())
    degrees = np.array(values, dtype=float).reshape(-1, 6)
    degrees[:, 2] += degrees[:, 1]
    return np.radians(degrees)


def posreg(q: np.ndarray, path: Path) -> None:
    """Write a FANUC's position registers, as a backup holds them."""
    lines = [f"[*POSREG*]$POSREG  Storage: CMOS  Access: RW  : ARRAY[1,{len(q) + 1}] OF Position Reg"]
    for k, posture in enumerate(fanuc_degrees(q), 1):
        joints = [f"J{j} = {value:9.3f} deg" for j, value in enumerate(posture, 1)]
        lines.append(f"    [1,{k}] =   ''   Group: 1")
        lines.append("  " + "   ".join(joints[:3]) + " ")
        lines.append("  " + "   ".join(joints[3:]) + " ")
        lines.append("")
    lines += [f"    [1,{len(q) + 1}] =   '' Uninitialized", ""]
    path.write_text("\n".join(lines))


def ros_node(program: Path) -> np.ndarray:
    """Return the joints [rad] in the list POSES of a Python node."""
    for statement in ast.parse(program.read_text()).body:
        if isinstance(statement, ast.Assign) and ast.unparse(statement.targets[0]) == "POSES":
            return np.array(ast.literal_eval(statement.value))
    raise ValueError(f"{program}: no list POSES")


def node_csv(q: np.ndarray, path: Path) -> None:
    """Write the CSV of joint states that the node leaves."""
    numbers = np.arange(1, len(q) + 1)
    formats = ["%d", *["%.9f"] * q.shape[1]]
    header = f"pose,{joint_header(q)}"
    np.savetxt(path, np.column_stack([numbers, q]), formats, ",", header=header, comments="")


def joint_header(q: np.ndarray) -> str:
    """Return the head of a CSV with the joints of q (m, n)."""
    return ",".join(f"joint{k + 1} [rad]" for k in range(q.shape[1]))


# ---- What the instrument writes: other order, poses that were not seen, decimal commas, inches -----------------------


def decimal_commas(values: np.ndarray, digits: int) -> list[str]:
    """Return numbers with decimal commas."""
    return [f"{value:.{digits}f}".replace(".", ",") for value in values]


def spatial_analyzer(points: np.ndarray, order: np.ndarray, path: Path) -> None:
    """Write SpatialAnalyzer's point list with decimal commas [mm]."""
    text = "// New River Kinematics\n// Units: millimeters\n"
    for k in order:
        cells = ["Cell", "Arm", f"P{k + 1}", *decimal_commas(1e3 * points[k], 4)]
        text += "\t".join(cells) + "\n"
    path.write_text(text)


def inches(points: np.ndarray, order: np.ndarray, path: Path) -> None:
    """Write a spreadsheet's text in inches, decimal commas, without names."""
    text = "Units: inches\nX;Y;Z\n"
    for k in order:
        text += ";".join(decimal_commas(points[k] / 0.0254, 6)) + "\n"
    path.write_text(text)


# ---- The part program that is to be corrected -----------------------------------------------------------------------


def ur_part(q: np.ndarray) -> str:
    """Return a part program of a UR."""
    moves = ""
    for posture in q.tolist():
        joints = [round(value, 9) for value in posture]
        moves += f"  movej({joints}, a=1.2, v=0.5)  # taught\n"
    return f"def part():\n  set_digital_out(0, True)\n{moves}end\n"


def tp_part(q: np.ndarray) -> str:
    """Return a part program of a FANUC."""
    moves = ""
    positions = ""
    for k, posture in enumerate(fanuc_degrees(q), 1):
        moves += f"{k:4d}:J P[{k}] 50% FINE ;\n"
        joints = [f"J{j}= {value:9.3f} deg" for j, value in enumerate(posture, 1)]
        arm = ",\t".join(joints[:3])
        wrist = ",\t".join(joints[3:])
        positions += f"P[{k}]{{\n   GP1:\n\tUF : 0, UT : 1,\t\n\t{arm},\n\t{wrist}\n}};\n"
    return f"/PROG  PART\n/ATTR\nLINE_COUNT\t= {len(q)};\n/MN\n{moves}/POS\n{positions}/END\n"


def csv_part(q: np.ndarray) -> str:
    """Return targets of a planner as CSV."""
    text = joint_header(q) + "\n"
    for posture in q:
        text += ",".join(f"{value:.9f}" for value in posture) + "\n"
    return text


def csv_targets(path: Path) -> np.ndarray:
    """Return the joints [rad] in the table that `calib compensate` wrote; a target that is not reached is NaN."""
    with path.open() as file:
        header, *rows = csv.reader(line for line in file if not line.startswith("#"))
    columns = [k for k, name in enumerate(header) if name.startswith("joint")]
    unit = np.pi / 180 if "[deg]" in header[columns[0]] else 1.0
    values = [[float(row[k] or "nan") for k in columns] for row in rows]
    return unit * np.array(values)


@dataclass(frozen=True)
class Arm:
    """An arm with its controller: how its program is read, what files controller and instrument leave.

    Attributes:
        robot: name in the library, or URDF.
        controller: as `calib new --program` takes it.
        program: ending of the programs' names.
        read_program: returns the joints (m, n) [rad] of a program that `calib` wrote.
        log: name of the file of joints; {} is the name of the planned poses.
        write_log: writes the joints (m, n) [rad] as the controller does.
        write_points: writes the points (m, 3) [m] in an order, as the instrument does.
        part: name of the part program.
        part_text: returns the part program of joints (m, n) [rad].
        read_part: returns the joints (m, n) [rad] of the corrected part program.
        checked: by which other rules programs are read here.
    """

    robot: str
    controller: str
    program: str
    read_program: Callable[[Path], np.ndarray]
    log: str
    write_log: Callable[[np.ndarray, Path], None]
    write_points: Callable[[np.ndarray, np.ndarray, Path], None]
    part: str
    part_text: Callable[[np.ndarray], str]
    read_part: Callable[[Path], np.ndarray]
    checked: str


UR5 = Arm(
    robot="ur5",
    controller="ur",
    program=".script",
    read_program=ur_script,
    log="{}_log.script",
    write_log=ur_log,
    write_points=spatial_analyzer,
    part="part.script",
    part_text=ur_part,
    read_part=ur_script,
    checked="programs: Python's literals",
)
LRMATE200ID = Arm(
    robot=str(HERE / "lrmate200id.urdf"),
    controller="fanuc",
    program=".ls",
    read_program=tp_program,
    log="{}_POSREG.VA",
    write_log=posreg,
    write_points=spatial_analyzer,
    part="part.ls",
    part_text=tp_part,
    read_part=tp_program,
    checked="programs: the sums of fanuc_driver, by hand",
)
LWR4PLUS = Arm(
    robot="lwr4plus",
    controller="ros2",
    program=".py",
    read_program=ros_node,
    log="{}_joints.csv",
    write_log=node_csv,
    write_points=inches,
    part="part.csv",
    part_text=csv_part,
    read_part=csv_targets,
    checked="programs: Python's own parser (ast)",
)
ARMS = {"ur5": UR5, "lrmate200id": LRMATE200ID, "lwr4plus": LWR4PLUS}


def rehearse(name: str, folder: Path) -> tuple[str, ...]:
    """Take one arm from `calib new` to a corrected program, in a folder; return its row of the table."""
    arm = ARMS[name]
    session = folder / "cell"
    cell = virtual_cell(arm.robot, SEED, TRACKER)
    installation = ("--robot", arm.robot, "--instrument", "tracker", "--program", arm.controller, "--geometry-only")
    counts = ("--poses", POSES, "--validation", VALIDATION, "--seed", SEED)
    command("new", "cell", *installation, *counts, folder=folder)
    command("next", "cell", "--no-plots", folder=folder)
    bring_measurements(arm, cell, session, folder)
    command("next", "cell", "--no-plots", folder=folder)
    report = command("deliver", "cell", "--for", arm.controller, folder=folder)
    (folder / "delivered.txt").write_text(report)

    # a part program at the validation poses, and its correction
    program = session / f"2-poses/validation_poses{arm.program}"
    q = measure(cell, arm.read_program(program), SEED).q
    (folder / arm.part).write_text(arm.part_text(q))
    corrected = f"sent{Path(arm.part).suffix}"
    command("compensate", "cell", arm.part, "--frame", "nominal", "--partial", "--out", corrected, folder=folder)
    commands = arm.read_part(folder / corrected)
    commands = np.where(np.isnan(commands), q, commands)

    nominal = forward(cell.nominal, q)
    true = true_poses(cell, q)
    delivered = urdf_poses(session / "6-export/robot.urdf", q)
    errors = (misfit(nominal, true), misfit(delivered, true), misfit(nominal, true_poses(cell, commands)))
    verdict = json.loads((session / "verdict.json").read_text())["verdict"]
    return (name, arm.controller, verdict, *(f"{error:.2f}" for error in errors), arm.checked)


def bring_measurements(arm: Arm, cell: Cell, session: Path, folder: Path) -> None:
    """Play the planned poses, write the files of controller and tracker, and join them for the session."""
    rng = np.random.default_rng(SEED)
    for planned, joined in SETS.items():
        program = session / f"2-poses/{planned}{arm.program}"
        measured = measure(cell, arm.read_program(program), SEED)
        order = rng.permutation(len(measured))
        if planned == "poses":
            order = order[:-HIDDEN]
        joints = arm.log.format(planned)
        points = f"{planned}_points.txt"
        arm.write_log(measured.q, folder / joints)
        arm.write_points(measured.position, order, folder / points)
        output = f"cell/3-measured/{joined}.csv"
        command("join", joints, points, "--robot", arm.robot, "--out", output, folder=folder)


def urdf_poses(path: Path, q: np.ndarray) -> np.ndarray:
    """Return the last joint's poses (m, 4, 4) [m] of a URDF, by Pinocchio."""
    model = pinocchio.buildModelFromUrdf(str(path))
    data = model.createData()
    poses = []
    for posture in q:
        pinocchio.forwardKinematics(model, data, posture)
        poses.append(data.oMi[model.njoints - 1].homogeneous)
    return np.array(poses)


def misfit(arm: np.ndarray, true: np.ndarray) -> float:
    """Return the rms distance [mm] of an arm's poses from true ones, instrument and target best placed."""

    def residual(x: np.ndarray) -> np.ndarray:
        station = Rotation.from_rotvec(x[:3])
        target = arm[:, :3, :3] @ x[6:] + arm[:, :3, 3]
        return 1e3 * (station.apply(target) + x[3:6] - true[:, :3, 3]).ravel()

    # the station's rotation has local minima: begin at a turn about each axis, both ways
    best_cost = np.inf
    for rotation in np.vstack([np.eye(3), -np.eye(3)]):
        fit = least_squares(residual, [*rotation, *np.zeros(6)])
        best_cost = min(best_cost, fit.cost)
    return float(np.sqrt(2.0 * best_cost / len(arm)))


HEADS = ("arm", "controller", "verdict", "nominal", "URDF delivered", "program sent", "checked by")
ABOUT = """# Rehearsal of three arms

Made by `python examples/cell/rehearsal.py`; the commands are in each arm's `commands.txt`. Errors [mm rms] are against
the hidden truth at poses that no fit has seen, instrument and target placed best: of the nominal arm, of `robot.urdf`
read by Pinocchio, and of the part program after `calib compensate` (targets that are not reached stay as they are). The
script wrote the files of joints and points.

"""


def main(arms: list[str], out: Path) -> None:
    """Rehearse with the arms; print the table and write it to README.md."""
    rows = [HEADS, ("---",) * len(HEADS)]
    for name in arms:
        folder = out / name
        folder.mkdir(parents=True)
        rows.append(rehearse(name, folder))
    table = "\n".join(f"| {' | '.join(row)} |" for row in rows)
    (out / "README.md").write_text(f"{ABOUT}{table}\n")
    print(table)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("arms", nargs="*", default=[*ARMS], help=", ".join(ARMS))
    parser.add_argument("--out", type=Path, default=Path("rehearsal"))
    options = parser.parse_args()
    main(options.arms, options.out)
