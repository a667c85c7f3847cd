"""Programs of poses for robot controllers: `calib program POSES.csv --for NAME`.

A program moves joint by joint to each pose, waits until the arm has settled, reads its joints, and then waits for the
operator's key, or raises a digital output for the instrument (``--output``). The pose's number is shown. The joints
that were read are where the program's head says; they are better than the planned ones, since those of the program are
rounded, and the arm stops only near them.

A program that was edited by hand is read again, ``calib program EDITED.src --for csv``, and so are the joints that a
KUKA keeps in its ``.dat`` file. `calib compensate FIT PROGRAM` corrects the targets inside a program.

A rail or a positioner beside the arm is an external axis, and a SCARA has four axes, of which the third slides
(`calib.controllers.axes`); sliding axes are in mm.
KRL has external axes as E1, RAPID as extax; TP as a second group, or with
``--external-group 1`` as E1 of the arm's; INFORM as a base axis if they slide, else as a station.

No program was run on a real controller. Run it first at low override, beam and cables off, one pose at a time.
"""

import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import jinja2
import numpy as np

from calib import files
from calib.apps.controller_programs.motion_streams import is_motion, setpoints, stream_values
from calib.apps.controller_programs.program_settings import CSV, ProgramSettings
from calib.apps.controller_programs.targets import Program, formatted, is_program, read_program
from calib.errors import UsageError
from calib.toolkit.chains import Axes, Controller, NamedJoint, PlainJoint, axes_of, check_pulses, controller_named
from calib.toolkit.pose_data import OURS, Joints, Table, read_poses, read_table
from calib.toolkit.report_pages import read_template
from calib.units import ANGLES, JOINT, LENGTHS


def joints_in(
    path: Path, source: str = "", settings: ProgramSettings | None = None
) -> tuple[np.ndarray, list[NamedJoint]]:
    """Return joint values (m, n) [rad or m] from a CSV of poses or from a program, and the joints.

    In a CSV, the joints are the columns whose header has the unit of an angle or, for sliding joints, of a length
    (``joint1 [deg]``, ``rail [mm]``).

    Args:
        path: the file.
        source: the controller of a program, where its suffix does not determine it; empty otherwise.
        settings: external axes and pulses of a program; None: the defaults.

    Raises:
        UsageError: a program whose targets are poses, or no column of joint values.
    """
    if source or is_program(path):
        program = _read(path, source, settings)
        if not program.of("joints"):
            raise UsageError(f"{path}: its targets are poses of the tool; give a list or program of joint values")
        return program.joints(), list(program.axes.joints)

    table = read_table(path)
    joints: list[NamedJoint] = []
    for name, unit in zip(table.header, table.units):
        if name in OURS:
            continue
        if unit.lower() in LENGTHS:
            joints.append(PlainJoint(name, "prismatic"))
        elif unit.lower() in ANGLES:
            joints.append(PlainJoint(name))
    if not joints:
        columns = ", ".join(table.header)
        raise UsageError(f"{path}: no column of joint angles with its unit, as 'joint1 [deg]'; found {columns}")
    names, kinds = zip(*((joint.name, joint.kind) for joint in joints))
    return read_poses(path, Joints(names, kinds)), joints


def _read(path: Path, source: str, settings: ProgramSettings | None) -> Program:
    """Return the program at `path`, read with the external axes and pulses of the settings."""
    settings = settings or ProgramSettings()
    return read_program(path, source, None, settings.external, settings.pulses)


def joints_table(path: Path, source: str = "", settings: ProgramSettings | None = None) -> Table:
    """Return the joint values in a file as a table [deg or mm], with a column ``pose`` where all targets are numbered.

    Args:
        path: CSV of poses, program, or file to which a controller wrote joint values: a UR's log, a KUKA's ``.dat``, a
            FANUC's ``POSREG.VA``.
        source: the controller of a program, where its suffix does not determine it; empty otherwise.
        settings: external axes and pulses of a program; None: the defaults.

    Raises:
        UsageError: as for `joints_in`.
    """
    q, joints = joints_in(path, source, settings)
    header = [joint.name for joint in joints]
    units, columns = [], []
    for joint, values in zip(joints, q.T):
        factor, unit = JOINT[joint.kind]
        units.append(unit)
        columns.append(values * factor)
    if source or is_program(path):
        program = _read(path, source, settings)
        numbers = np.array([program.targets[k].number for k in program.of("joints")])
        if numbers.all():
            header.insert(0, "pose")
            units.insert(0, "")
            columns.insert(0, numbers)
    rows = np.arange(1, len(q) + 1)
    return Table(str(path), tuple(header), tuple(units), tuple(columns), rows)


def program_files(
    path: Path, out: Path, name: str, settings: ProgramSettings | None = None, source: str = ""
) -> dict[Path, str]:
    """Return the text of each file of a program made from the poses in a CSV file or in another program, by path.

    Args:
        path: CSV of poses (``joint1 [deg]``) or of a motion (``t [s]``), or a program whose targets are joint values.
        out: the output path; its name without suffix is the program's name. A program of one file is written to exactly
            this path; without a suffix, and for programs of several files, the suffixes are the controller's.
        name: name of a controller, or ``csv`` for the poses as a table.
        settings: how the program moves and waits; None: the defaults.
        source: the controller of a program at `path`, where its suffix does not determine it; empty otherwise.

    Raises:
        UsageError: an unknown controller, a program name that the controller does not accept, another number of axes,
            or a digital output or groups of axes that the controller does not have.
    """
    settings = settings or ProgramSettings()
    if name == CSV:
        return {out: _csv_text(joints_table(path, source, settings))}
    controller = controller_named(name)
    stem = out.stem
    if not re.fullmatch(controller.names, stem):
        rule = _name_rule(controller.names)
        raise UsageError(f"{out}: '{stem}' is no name for a program of {controller.title}: {rule}")

    if settings.external_group is not None and not controller.rail_group:
        raise UsageError(f"--external-group: programs for {controller.title} have no groups of axes; leave it out")

    moving = not (source or is_program(path)) and is_motion(path)
    if moving:
        q, joints = setpoints(path, controller)
    else:
        q, joints = joints_in(path, source, settings)
    axes = axes_of(controller, joints, settings.external)
    check_pulses(controller, axes, settings.pulses)
    if settings.output is not None and not controller.outputs:
        raise UsageError(f"--output: in programs for {controller.title} the operator presses a key; leave it out")
    values: dict[str, object]
    if moving:
        templates = controller.stream
        values = {**stream_values(controller, axes, q)}
    else:
        templates = controller.files
        values = _poses(controller, axes, q, settings)
    values["name"] = stem
    values["head"] = _head(controller, axes, moving)
    values["settle"] = settings.settle
    values["speed"] = settings.speed
    values["output"] = settings.output
    values["pulses"] = settings.pulses
    file_names = [pattern.format(name=stem) for pattern in templates.values()]
    texts = {}
    for target, template in zip(_targets(out, file_names, controller), templates):
        texts[target] = _template(template).render(values)
    return texts


def _csv_text(table: Table) -> str:
    """Return a table as CSV text, with units in the header and numbers of twelve digits."""
    header = [f"{name} [{unit}]" if unit else name for name, unit in zip(table.header, table.units)]
    lines = [",".join(header)]
    for row in zip(*table.cells):
        numbers = [f"{value:.12g}" for value in row]
        lines.append(",".join(numbers))
    return "\n".join([*lines, ""])


def _targets(out: Path, names: list[str], controller: Controller) -> list[Path]:
    """Return the paths at which a program's files are written.

    Args:
        out: the output path.
        names: file names by the controller's convention.
        controller: the controller.
    """
    usual = [out.with_name(name) for name in names]
    if not out.suffix:
        return usual
    if len(names) == 1:
        return [out]
    suffixes = [path.suffix for path in usual]
    if out.suffix.lower() not in suffixes:
        together = f"{', '.join(suffixes)}, written together"
        raise UsageError(f"{out}: {controller.title} takes {together}; end the name in {suffixes[0]}")
    return usual


def write_program(path: Path, out: Path, name: str, external: Sequence[str] = ()) -> list[Path]:
    """Write the program that drives a session's planned poses, and return the paths of its files.

    Args:
        path: CSV of the planned poses.
        out: the output path.
        name: name of a controller.
        external: names of the external axes; empty: those that the joints show.
    """
    texts = program_files(path, out, name, ProgramSettings(external=tuple(external)))
    return [files.write(target, text) for target, text in texts.items()]


def _poses(controller: Controller, axes: Axes, q: np.ndarray, settings: ProgramSettings) -> dict[str, object]:
    """Return the variables of a template with poses q (m, n) [rad or m], by name.

    They are the numbers of the arm's axes (``poses``) and of the external ones (``external``) in the controller's units
    and number of decimals, and what the axes are.

    Args:
        controller: the controller.
        axes: its axes.
        q: joint values, in the description's order.
        settings: settings of the program: pulses, and group of the external axes.
    """
    values = axes.shown(controller, q)
    if controller.pulses:
        values = values * np.array(settings.pulses)
    texts = formatted(values, controller.decimals)
    count = len(axes.arm)
    units = axes.units(controller.unit)
    names = [axes.joints[index].name for index in axes.order]
    poses, external = [], []
    for row in texts:
        poses.append(row[:count])
        external.append(row[count:])
    return {
        "poses": poses,
        "external": external,
        "group": _group(controller, axes, settings),
        "joints": names,
        "units": units,
        "scara": axes.scara,
    }


def _group(controller: Controller, axes: Axes, settings: ProgramSettings) -> int:
    """Return the group of the external axes: 1, the arm's, or 2, their own; 0 without external axes."""
    if not axes.external:
        return 0
    if settings.external_group is not None:
        return settings.external_group
    if any(axes.turning[index] for index in axes.external):
        return 2
    return controller.rail_group


def _head(controller: Controller, axes: Axes, moving: bool) -> list[str]:
    """Return the comment lines at a program's head: safety notes and the joints' names.

    Args:
        controller: the controller.
        axes: its axes; in the line of joints, external ones have their label, and sliding ones their unit.
        moving: whether the program plays a motion rather than a list of poses.
    """
    units = dict(zip(axes.order, axes.units(controller.unit)))
    labels = dict(zip(axes.order, axes.labels()))
    names = []
    for index, joint in enumerate(axes.joints):
        remarks = []
        if index in axes.external:
            remarks = [labels[index], units[index]]
        elif not axes.turning[index]:
            remarks = [units[index]]
        name = joint.name
        if remarks:
            name += f" ({', '.join(remarks)})"
        names.append(name)
    joints = [f"Joints: {', '.join(names)}."]
    arm_names = [axes.joints[index].name for index in axes.arm]
    coupled = controller.coupled
    if axes.scara:
        coupled = ()
    for axis, partner, sign in coupled:
        operator = {1: "+", -1: "-"}[sign]
        joints.append(f"Axis {axis} = {arm_names[axis - 1]} {operator} {arm_names[partner - 1]}.")
    if moving:
        return ["Not run on a real controller.", "Simulate first, then run at low override.", *joints]
    head = [
        f"Not run on a real controller; checked by {controller.checked}.",
        "Simulate first, then run at low override, one pose at a time.",
        *joints,
    ]
    if controller.keeps:
        head.append(f"Joints read at each pose: {controller.keeps}.")
    return head


def _name_rule(pattern: str) -> str:
    rule = "letters, digits and _, a letter first"
    longest = re.search(r"\{0,(\d+)\}", pattern)
    if longest is None:
        return rule
    return f"{rule}, at most {int(longest[1]) + 1}"


@cache
def _template(file: str) -> jinja2.Template:
    environment = jinja2.Environment(
        trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True, undefined=jinja2.StrictUndefined
    )
    return environment.from_string(read_template("calib.apps.controller_programs", f"templates/{file}"))
