"""A ROS 2 package of the calibrated robot: ``calib export FIT --ros2 ur5_description --out src``.

``src/ur5_description`` with ``package.xml`` and ``CMakeLists.txt`` (ament_cmake), ``urdf/ur5.urdf``, its meshes,
``launch/display.launch.py`` (robot_state_publisher, sliders, RViz) and, with ``--moveit``, MoveIt's SRDF and
``joint_limits.yaml`` in ``config``: to be built by colcon and shown by ``ros2 launch ur5_description
display.launch.py``. Names follow REP 149.

The URDF is that of `calib export --urdf`: calibrated origins, identified masses where there are any, all else as it
was, a ``<ros2_control>`` included. ``--ros2-control`` writes one, for mock hardware, where there is none. Meshes that
are found (`ROS_PACKAGE_PATH` helps) are copied and named ``package://NAME/meshes/…``, pictures that they name are not;
others stay as they are written, and their packages become dependencies. Pinocchio and yourdfpy read the finished URDF
again; no ROS was at hand to build it. Maintainer and license are left to be filled in, as `ros2 pkg create` does.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from xml.sax.saxutils import escape, quoteattr

from calib import files
from calib.errors import UsageError, require
from calib.files import shipped_text
from calib.procedure.export.delivery import Export, deliver_single
from calib.procedure.export.geometry import check_readback
from calib.procedure.kinematic_stage.folder import URDF
from calib.procedure.measuring.moveit import limit_tables, moveit_files
from calib.robot.chain import Chain
from calib.robot.collision import find_mesh, urdf_meshes
from calib.robot.descriptions.xacro_arguments import split
from calib.robot.formats.urdf_tree import edited, set_attributes, text
from calib.robot.formats.urdf_tree import read as read_tree

HERE = "calib.procedure.export"
NAME = re.compile(r"[a-z][a-z0-9]*(_[a-z0-9]+)*")  # REP 149's [a-z](_?[a-z0-9]+)*, without its backtracking
SHOWS = ("robot_state_publisher", "joint_state_publisher_gui", "rviz2")
FILES = {
    "package.xml": "package.xml",
    "CMakeLists.txt": "CMakeLists.txt",
    "display.rviz": "rviz/display.rviz",
    "display.launch.template": "launch/display.launch.py",
}
_PACKAGE = re.compile(r"package://([^/]+)/")


def write_package(
    export: Export,
    name: str,
    into: Path,
    *,
    moveit: Sequence[Path] = (),
    control: bool = False,
    overwrite: bool = False,
) -> tuple[str, ...]:
    """Write a ROS 2 package of a calibrated robot and return remarks for the user.

    Args:
        export: sources of the export.
        name: name of the package.
        into: folder in which the package's folder is created.
        moveit: files to copy: SRDF, joint_limits.yaml, or a folder with both.
        control: whether to write a <ros2_control> for mock hardware if the URDF has none.
        overwrite: whether to replace existing files.

    Raises:
        UsageError: for a name that is not valid for a ROS 2 package, and for MoveIt files of another robot.
        RobotError: if the finished URDF, read back, differs from the robot; nothing is written.
    """
    likely = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")
    words = f"--ros2 {name}: a package's name has lower-case letters, digits and single _, a letter first (REP 149)"
    require(NAME.fullmatch(name), f"{words}{f', as {likely}' if NAME.fullmatch(likely) else ''}", UsageError)
    target, robot, chain = into / name, name.removesuffix("_description"), export.robot.chain
    configs = {f"config/{file.name}": file for path in moveit for file in moveit_files(path)}
    for file in configs.values():
        limit_tables(file, chain, export.urdf)
    with TemporaryDirectory() as place:
        path = Path(place) / f"{robot}.urdf"
        notes = deliver_single(export, {URDF: path})
        content, encoding = text(path)
        content, meshes, lost = _with_own_meshes(path, content, name, export.urdf)
    if control and "<ros2_control" not in content:
        content = _with_control(content, robot, chain)
        notes.append("<ros2_control> is for mock hardware: name your robot's plugin in it")
    check_readback(content, str(target), chain)
    if lost:
        notes.append(f"{len(lost)} meshes were not found; their file names are unchanged, such as {lost[0]}")
    needed = dict.fromkeys([*SHOWS, *(match[1] for each in lost if (match := _PACKAGE.match(each)))])
    made: dict[str, str | bytes] = {f"urdf/{robot}.urdf": content.encode(encoding)}
    made |= {place: file.read_bytes() for place, file in {**meshes, **configs}.items()}
    words = {
        "NAME": name,
        "ROBOT": robot,
        "ROOT": read_tree(content, name).roots[0],
        "ABOUT": escape(f"{chain.name}, calibrated by armature-calib. {export.remark}".strip()),
        "DEPENDS": "\n".join(f"  <exec_depend>{each}</exec_depend>" for each in needed),
        "FOLDERS": " ".join(sorted({each.split("/")[0] for each in (*made, *FILES.values()) if "/" in each})),
    }
    for template, place in FILES.items():
        made[place] = re.sub(r"@([A-Z]+)@", lambda found: words[found[1]], shipped_text(HERE, f"templates/{template}"))
    files.check_results([(target / place, ()) for place in made], [export.urdf, *configs.values()], overwrite)
    with files.together():
        for place, written in made.items():
            files.write(target / place, written)
    return (*notes, f"{len(meshes)} meshes copied; fill in maintainer and license in {target / 'package.xml'}")


def _with_own_meshes(
    path: Path, content: str, name: str, source: Path | None
) -> tuple[str, dict[str, Path], list[str]]:
    """Return a URDF's text with mesh names changed to paths in the package, the found meshes, and names of lost ones.

    Args:
        path: path of the URDF.
        content: text of the URDF.
        name: name of the package.
        source: URDF of the nominal robot, whose folder is searched for meshes; None: no search.

    Returns:
        The text, path in the package -> path of the mesh, and the names of meshes that were not found.
    """
    folders = [] if source is None else list(Path(split(str(source))[0]).resolve().parents)
    changes, meshes, lost = list[tuple[int, int, str]](), dict[str, Path](), list[str]()
    for _, _, node in (*urdf_meshes(path, "visual"), *urdf_meshes(path, "collision")):
        written = node.attributes.get("filename", "")
        found = find_mesh(written, folders)
        if found is None:
            lost.append(written)
            continue
        inner = [
            part for part in Path(_PACKAGE.sub("", written).removeprefix("file://")).parts if part not in ("/", "..")
        ]
        place = Path("meshes", *(inner[1:] if inner[0] == "meshes" else inner))
        while meshes.get(str(place), found) != found:
            place = place.with_stem(f"{place.stem}_")
        meshes[str(place)] = found
        changes += set_attributes(content, node, {"filename": f"package://{name}/{place}"})
    return edited(content, changes), meshes, lost


def _with_control(content: str, robot: str, chain: Chain) -> str:
    """Return a URDF's text with an added <ros2_control> for mock hardware with position commands.

    Args:
        content: text of the URDF.
        robot: name of the robot.
        chain: the arm, whose joints are controlled.
    """
    joints = "".join(
        f'    <joint name={quoteattr(name)}>\n      <command_interface name="position"/>\n'
        '      <state_interface name="position"/>\n      <state_interface name="velocity"/>\n    </joint>\n'
        for name in chain.joint_names
    )
    head = f'  <ros2_control name="{robot}" type="system">\n    <hardware>\n'
    plugin = "      <plugin>mock_components/GenericSystem</plugin>\n    </hardware>\n"
    before, end, after = content.rpartition("</robot>")
    return f"{before}{head}{plugin}{joints}  </ros2_control>\n{end}{after}"
