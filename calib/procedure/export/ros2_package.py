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
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple
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

TEMPLATE_PACKAGE = "calib.procedure.export"
# REP 149's [a-z](_?[a-z0-9]+)*, without its backtracking
PACKAGE_NAME = re.compile(r"[a-z][a-z0-9]*(_[a-z0-9]+)*")
DISPLAY_PACKAGES = ("robot_state_publisher", "joint_state_publisher_gui", "rviz2")
# template -> its path in the package
TEMPLATES = {
    "package.xml": "package.xml",
    "CMakeLists.txt": "CMakeLists.txt",
    "display.rviz": "rviz/display.rviz",
    "display.launch.template": "launch/display.launch.py",
}
_PACKAGE_URI = re.compile(r"package://([^/]+)/")


class _Meshes(NamedTuple):
    """A URDF's text with its meshes in the package.

    Attributes:
        content: the text, with the mesh names changed.
        copies: path in the package -> path of the mesh that is copied there.
        missing: names of meshes that were not found.
    """

    content: str
    copies: dict[str, Path]
    missing: list[str]


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
    _check_name(name)
    target = into / name
    robot_name = name.removesuffix("_description")
    chain = export.robot.chain
    configs: dict[str, Path] = {}
    for path in moveit:
        for file in moveit_files(path):
            limit_tables(file, chain, export.urdf)
            configs[f"config/{file.name}"] = file

    with TemporaryDirectory() as folder:
        urdf = Path(folder) / f"{robot_name}.urdf"
        notes = deliver_single(export, {URDF: urdf})
        content, encoding = text(urdf)
        meshes = _with_package_meshes(urdf, content, name, export.urdf)
    content = meshes.content
    if control and "<ros2_control" not in content:
        content = _with_control(content, robot_name, chain)
        notes.append("<ros2_control> is for mock hardware: name your robot's plugin in it")
    check_readback(content, str(target), chain)
    if meshes.missing:
        example = meshes.missing[0]
        notes.append(f"{len(meshes.missing)} meshes were not found; their file names are unchanged, such as {example}")

    contents: dict[str, str | bytes] = {f"urdf/{robot_name}.urdf": content.encode(encoding)}
    for path, file in {**meshes.copies, **configs}.items():
        contents[path] = file.read_bytes()
    fields = {
        "NAME": name,
        "ROBOT": robot_name,
        "ROOT": read_tree(content, name).roots[0],
        "ABOUT": escape(f"{chain.name}, calibrated by armature-calib. {export.remark}".strip()),
        "DEPENDS": _dependencies(meshes.missing),
        "FOLDERS": _folders([*contents, *TEMPLATES.values()]),
    }
    for template, path in TEMPLATES.items():
        contents[path] = _filled(template, fields)

    results = [(target / path, ()) for path in contents]
    files.check_results(results, [export.urdf, *configs.values()], overwrite)
    with files.together():
        for path, written in contents.items():
            files.write(target / path, written)
    remark = f"{len(meshes.copies)} meshes copied; fill in maintainer and license in {target / 'package.xml'}"
    return (*notes, remark)


def _check_name(name: str) -> None:
    """Refuse a name that REP 149 does not allow, with the nearest one that it does.

    Raises:
        UsageError: for such a name.
    """
    allowed = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")
    message = f"--ros2 {name}: a package's name has lower-case letters, digits and single _, a letter first (REP 149)"
    if PACKAGE_NAME.fullmatch(allowed):
        message += f", as {allowed}"
    require(PACKAGE_NAME.fullmatch(name), message, UsageError)


def _dependencies(missing: Sequence[str]) -> str:
    """Return the lines of ``package.xml`` with what the package needs to run.

    Args:
        missing: names of meshes that are not copied: their packages are needed.
    """
    packages = dict.fromkeys(DISPLAY_PACKAGES)
    for mesh in missing:
        uri = _PACKAGE_URI.match(mesh)
        if uri:
            packages[uri[1]] = None
    return "\n".join(f"  <exec_depend>{package}</exec_depend>" for package in packages)


def _folders(paths: Sequence[str]) -> str:
    """Return the package's folders, sorted, for its ``CMakeLists.txt``."""
    folders = {path.split("/")[0] for path in paths if "/" in path}
    return " ".join(sorted(folders))


def _filled(template: str, fields: Mapping[str, str]) -> str:
    """Return the text of a template in which each ``@NAME@`` is replaced by the field of that name."""

    def field(mark: re.Match[str]) -> str:
        return fields[mark[1]]

    return re.sub(r"@([A-Z]+)@", field, shipped_text(TEMPLATE_PACKAGE, f"templates/{template}"))


def _with_package_meshes(urdf: Path, content: str, name: str, source: Path | None) -> _Meshes:
    """Return a URDF's text with the names of the found meshes changed to paths in the package.

    Args:
        urdf: path of the URDF.
        content: text of the URDF.
        name: name of the package.
        source: URDF of the nominal robot, whose folder is searched for meshes; None: no search.
    """
    folders: list[Path] = []
    if source is not None:
        folders = list(Path(split(str(source))[0]).resolve().parents)
    changes: list[tuple[int, int, str]] = []
    copies: dict[str, Path] = {}
    missing: list[str] = []
    for _, _, node in (*urdf_meshes(urdf, "visual"), *urdf_meshes(urdf, "collision")):
        uri = node.attributes.get("filename", "")
        mesh = find_mesh(uri, folders)
        if mesh is None:
            missing.append(uri)
            continue
        path = _path_in_package(uri)
        # a different mesh of the same name gets another path
        while copies.get(str(path), mesh) != mesh:
            path = path.with_stem(f"{path.stem}_")
        copies[str(path)] = mesh
        changes += set_attributes(content, node, {"filename": f"package://{name}/{path}"})
    return _Meshes(edited(content, changes), copies, missing)


def _path_in_package(uri: str) -> Path:
    """Return the path below ``meshes`` at which a mesh is copied: that in its own package, or on the disk."""
    parts = list(Path(_PACKAGE_URI.sub("", uri).removeprefix("file://")).parts)
    inner = [part for part in parts if part not in ("/", "..")]
    if inner[0] == "meshes":
        inner = inner[1:]
    return Path("meshes", *inner)


def _with_control(content: str, robot: str, chain: Chain) -> str:
    """Return a URDF's text with an added <ros2_control> for mock hardware with position commands.

    Args:
        content: text of the URDF.
        robot: name of the robot.
        chain: the arm, whose joints are controlled.
    """
    joints = ""
    for joint in chain.joint_names:
        joints += (
            f'    <joint name={quoteattr(joint)}>\n      <command_interface name="position"/>\n'
            '      <state_interface name="position"/>\n      <state_interface name="velocity"/>\n    </joint>\n'
        )
    head = f'  <ros2_control name="{robot}" type="system">\n    <hardware>\n'
    plugin = "      <plugin>mock_components/GenericSystem</plugin>\n    </hardware>\n"
    before, end, after = content.rpartition("</robot>")
    return f"{before}{head}{plugin}{joints}  </ros2_control>\n{end}{after}"
