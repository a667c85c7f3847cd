"""What a session asks of people, in two lines: what to do at the robot, and which file to bring, in which form."""

from pathlib import Path

from calib.data.csv_table import read_table
from calib.data.poses.choices import IMAGES
from calib.errors import SessionError, command_line
from calib.procedure.excitation.coefficients import RUN, SAMPLES
from calib.procedure.session.folder import UNSEEN, WAYS, Session
from calib.procedure.session.geometry_steps import chain_of
from calib.procedure.session.steps import WAITING, State
from calib.robot.chain import Chain


def asks(session: Session, state: State) -> tuple[str, str]:
    """Return two lines: what to do at the robot, and which file to bring, in which form."""
    if state.kind == WAITING and state.step.name in ("record", "predict"):
        return _play(session, state.step.name), _log(session, state.step.name)
    if state.kind == WAITING and state.step.name in ("measure", "validate"):
        name = "poses" if state.step.name == "measure" else "validation"
        target = "measured.csv" if name == "poses" else UNSEEN
        both = name == "poses" and not session.brought("validation")
        return _at_the_robot(session, name, both), _form(session, target, both)
    again = f"put it into {session.folder} and run {command_line('next', session.folder)} again"
    return f"step {state.step.name} needs {state.words}", again


def _at_the_robot(session: Session, name: str, both: bool) -> str:
    path = session.path(f"2-poses/{name}.csv")
    if session.settings.instrument.measures == IMAGES:
        return _take_images(session, path, both)
    what = "pose" if session.settings.instrument.measures == "pose" else "position"
    device = session.settings.instrument.name
    if not session.settings.poses.plan or not path.exists():
        return f"Measure the target's {what} with the {device} at poses all over the workspace."
    ways = session.path(f"2-poses/{WAYS}")
    order = f" in their order (ways: {ways}; calib view {session.folder} rehearses them)"
    return (
        f"Drive the {len(read_table(path))} poses of {path}{order if name == 'poses' and ways.exists() else ''}"
        f"{_and_validation(session) if both else ''}, let the arm settle, measure the "
        f"target's {what} with the {device} and log the joint angles read back; the first three once more at the end "
        "show drift "
        "(into drift.csv, if you like)."
    )


def _take_images(session: Session, path: Path, both: bool) -> str:
    """Say how images are to be taken."""
    where = "poses all over the workspace that see the board from near and far, and tilted"
    if session.settings.poses.plan and path.exists():
        where = f"the {len(read_table(path))} poses of {path}{_and_validation(session) if both else ''}"
    return (
        f"Drive {where}; at each let the arm settle for a second, take an image of the board (focus, zoom and exposure "
        "fixed, no automatic ones, no image turned or scaled), and log the joint angles read back."
    )


def _and_validation(session: Session) -> str:
    """Name the list of validation poses, so that the robot is visited once."""
    path = session.path(f"2-poses/{UNSEEN}")
    if not session.settings.poses.validation or not path.exists():
        return ""
    return f" and, into a file of their own, the {len(read_table(path))} of {path} (never fitted)"


def _form(session: Session, target: str, both: bool) -> str:
    joints = _chain(session).joint_names
    if session.settings.instrument.measures == IMAGES:
        return _form_of_images(session, joints, target, both)
    full = session.settings.instrument.measures == "pose"
    columns = ", ".join((*(f"{joint} [deg]" for joint in joints), *(f"{axis} [mm]" for axis in "xyz")))
    quaternion = ", qx, qy, qz, qw" if full else ""
    files = [str(session.path("3-measured") / target)]
    if both and session.settings.poses.validation:
        files.append(str(session.path(f"3-measured/{UNSEEN}")))
    each = f"Bring {' and '.join(files)}, one row per pose: {columns}{quaternion} (calib formats measurements)"
    return f"{each}; then: {command_line('next', session.folder)}"


def _form_of_images(session: Session, joints: tuple[str, ...], target: str, both: bool) -> str:
    """Say where images, joint values and the board's description go."""
    names = [target, *([UNSEEN] if both and session.settings.poses.validation else [])]
    folders = " and ".join(str(session.path("3-measured") / Path(name).stem) for name in names)
    return (
        f"Bring {folders}: the images, joints.csv (image, {joints[0]} [deg] … {joints[-1]} [deg]; one row per image), "
        "board.toml (calib board makes boards), and camera.yaml if the lens is known (calib formats images); then: "
        f"{command_line('next', session.folder)}"
    )


def _play(session: Session, step: str) -> str:
    """Return what is to be played and logged."""
    wanted = session.settings.dynamics
    names = _motions(session, step)
    if not wanted.plan:
        return "Record the robot moving in all its joints, in one motion for training and in another, unseen one."
    file = RUN if wanted.repeats > 1 else SAMPLES
    motions = " and, into a file of its own, ".join(str(session.path(f"6-excitation/{name}/{file}")) for name in names)
    unseen = " (never used for training)" if "validation" in names else ""
    loads = ", ".join(f"'{label}' ({mass:g} kg)" for label, mass in wanted.payloads.items())
    again = f" Then once more with {loads} on the flange, the label in the file's name." if loads else ""
    return (
        f"Play {motions}{unseen}, {wanted.repeats} times the motion each, at {wanted.rate:g} Hz, from rest at "
        "its "
        "first row, before that at a low override, to see that the way is free; log joint positions and torques "
        "all "
        f"the while.{again if step == 'record' else ''}"
    )


def _motions(session: Session, step: str) -> list[str]:
    """Return which of the motions are still to be recorded."""
    names = [] if step == "predict" or session.brought("training") else ["training"]
    return names + (["validation"] if session.settings.dynamics.validation and not session.brought("unseen") else [])


def _log(session: Session, step: str) -> str:
    chain = _chain(session)
    torques = session.settings.dynamics.torques
    first, last = chain.joint_names[0], chain.joint_names[-1]
    unit = ["N" if joint.kind == "prismatic" else "Nm" for joint in chain.joints]
    place = ["m" if joint.kind == "prismatic" else "deg" for joint in chain.joints]
    columns = [f"q_{first} [{place[0]}] to q_{last} [{place[-1]}]"]
    if torques != "link":
        columns.append(f"tau_{first} [{unit[0]}] to tau_{last} [{unit[-1]}]")
    if torques != "motor":
        columns.append(f"tau_link_{first} to tau_link_{last} (the sensors')")
    files = " and ".join(str(session.path(f"7-recorded/{name}.csv")) for name in _motions(session, step))
    return (
        f"Bring {files}, one row per sample: t [s], {', '.join(columns)}; currents are i_{first} [A] …; .npz and ROS "
        "bags "
        f"are read, too (calib formats recordings); then: {command_line('next', session.folder)}"
    )


def _chain(session: Session) -> Chain:
    try:
        return chain_of(session)
    except Exception as error:
        raise SessionError(f"the robot cannot be read: {error}") from error
