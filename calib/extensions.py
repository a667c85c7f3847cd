"""Extensions of the core by the packages in `calib.rooms`: listed by folder, loaded at first use.

A room is a package of `calib.rooms` with a table ``OFFERS``: what it adds, and where, as ``module:name`` below the room
(``:name`` for the package itself, ``module:`` for a module). The core asks for

    commands               typer apps of `calib`
    topics, schemas        of `calib formats`: see `calib.procedure.formats`
    methods                of identification: tuples of `calib.identification.methods.method.Method`
    loop_results           function: problem, estimate → `calib.identification.loop.LoopResults`
    link_motion            function: robot, case, settings → the case with its links' motion, moved by joint corrections
    deflection_sensitivity function: identification, robot, cases → derivative of the estimate by their coefficients
    identified_masses      function: folder of an identification, chain → standard parameters (n, 10) of its bodies
    return_masses          function: session → notes; hands identified masses to its fit
    track                  function: inputs, dynamics, predictions, controller → replays with the model fed forward
    robots                 functions: what a person names → `calib.procedure.robot_kinds.Mechanism`, or None
    descriptions           a module: `takes` tells by its name whether a file is another program's description of a
                           robot, `urdf` returns it as the text of a URDF
    limit_tables           functions: path, arm, its file → tables of `calib formats limits`, None for other files
    ros2_package           function: see `calib.rooms.descriptions.ros2_package`
    library                folder of the robots that go by a name
    stages                 their verbs: tables of kind → verb → `calib.procedure.robot_kinds.Stage`
    drive_gains            function: robot, cases of currents, settings, known parameters, reference joint → gains of
                           a robot that is not a serial arm (`calib.identification.gains.DriveGains`)
    image_folders          a module: `read_images` reads a folder of images as a block of measurements
    exports                functions: path → the file as a stream of our text, None where it is our table already
    read_bag               function: ROS bag, joints, options → `calib.data.recordings.recording.Recording`
    pose_forms             files of poses that are no standard table: by ``format``, whether a header is of that form,
                           and its reader
    planned_poses          function: file of points, nominal arm, options → blocks with the joints of planned poses
    camera_guess           a module: lenses of images completed, images as poses
    optics                 of kinds of measurement that are not the core's: their instruments' parameters
                           (`calib.geometry.installation.NoOptics`); loading it registers guesses and residuals
    read_optics            the same from the tables of a fit's ``robot.toml``
    camera_view            what a camera sees, of a constraints file; read_lens, read_board: its files
    fit_notes              functions: a fit → findings on it; image_coverage, reprojection: figures of its images
    image_words            what is said of images as they arrive
    recordings             functions: a session's folder → the name of the recording written there
    steps, endings         of a session: steps after the export; functions: a complete session → lines to print
    fit_pages, model_pages functions that write the certificate of a fit and of an identification into its folder
                           (report, figures by name, folder)
    check_controller       function: controller's name, number of joints; raises where it takes no such arm
    write_program          function: CSV of poses, path, controller's name → files of its program
    joint_origins          function: texts of a nominal and a calibrated URDF, their name → YAML for tesseract
    ur_kinematics          function: calibrated robot, its URDF → YAML for ur_description, and a remark
    as_described           function: controller's name, joints as it shows them → the description's joints;
    motors_as_described    the same of motors' torques and currents
    notebook               function: a result → HTML
    geometry_spread        function: see `calib.procedure.excitation.prior_motions.GeometrySpread`

A room that is deleted takes its commands, methods and robots along; the rest works without.
"""

from __future__ import annotations

import pkgutil
from functools import cache
from importlib import import_module
from typing import Any

from calib.errors import UsageError

ROOMS = "calib.rooms"


def offered(what: str) -> list[Any]:
    """Return the extensions that packages registered under the name `what`, in the order of the packages' names."""
    return [_loaded(room, places[what]) for room, places in _offers().items() if what in places]


def merged(what: str) -> dict[str, Any]:
    """Return one table merged from the tables that packages registered under the name `what`."""
    return {key: value for table in offered(what) for key, value in table.items()}


def needed(what: str) -> Any:
    """Return the extension that a package registered under the name `what`.

    Raises:
        UsageError: where no room offers it.
    """
    for each in offered(what):
        return each
    raise UsageError(f"{what.replace('_', ' ')}: no package of {ROOMS} provides it; install the toolkit again")


@cache
def _offers() -> dict[str, dict[str, str]]:
    """Return each package's table of extensions, by the package's full name."""
    try:
        package = import_module(ROOMS)
    except ImportError:
        return {}
    names = sorted(f"{ROOMS}.{each.name}" for each in pkgutil.iter_modules(package.__path__))
    return {name: import_module(name).OFFERS for name in names}


def _loaded(room: str, place: str) -> Any:
    module, _, name = place.rpartition(":")
    found = import_module(f"{room}.{module}" if module else room)
    return getattr(found, name) if name else found
