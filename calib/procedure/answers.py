"""Answers to the questions of `calib new`, as command options or from a terminal.

This module imports only small modules, so that `calib` starts fast.
"""

from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from typing import Annotated
from unicodedata import category

from calib.config import strict
from calib.config_types import Checked, Expect, OneOf, Real, Text, Typed, Whole

CAMERA = ("mounting", "lens", "board", "carried", "stands")
CELL = ("instrument_at", "cone", "facing", "box", "obstacles", *CAMERA)
Held = Annotated[float, Real(least=-3.0, most=3.0, unit="m", quantity="length")]
Torques = Annotated[str, OneOf(("motor", "link", "both"))]
Tolerance = Annotated[float, Real(least=0.0, quantity="1")]
# of one entry of a certificate
MAX_LETTERS = 200


def _entry(value: object) -> object:
    """Return an entry of a certificate (text, number or date) as one line of printable text.

    Values of other types are returned unchanged.

    Args:
        value: the entry.

    Raises:
        ValueError: for a text that is too long.
    """
    if not isinstance(value, str | int | float | date) or isinstance(value, bool):
        return value
    # control characters and halves of surrogate pairs cannot be printed
    printable = [" " if category(letter) in ("Cc", "Cs") else letter for letter in str(value)]
    line = " ".join("".join(printable).split())
    if len(line) > MAX_LETTERS:
        raise ValueError(f"expected at most {MAX_LETTERS} letters, found {len(line)}")
    return line


StatedEntry = Annotated[Text, Checked(_entry, {"type": ["string", "number"]})]


@strict
@dataclass(frozen=True)
class CertificateSection:
    """Section ``[certificate]``: information on the certificate besides results; empty: a blank line to fill in by
    hand.

    Attributes:
        certificate_number: certificate number
        robot_make: robot make and type
        robot_serial: robot serial number
        controller: controller
        controller_software: controller software
        instrument_serial: instrument serial number
        instrument_calibrated: instrument calibrated on
        temperature: temperature
        flange_load: payload at the flange
        operator: operator
        place: place
        measured_on: date of measurement
    """

    certificate_number: StatedEntry = ""
    robot_make: StatedEntry = ""
    robot_serial: StatedEntry = ""
    controller: StatedEntry = ""
    controller_software: StatedEntry = ""
    instrument_serial: StatedEntry = ""
    instrument_calibrated: StatedEntry = ""
    temperature: StatedEntry = ""
    flange_load: StatedEntry = ""
    operator: StatedEntry = ""
    place: StatedEntry = ""
    measured_on: StatedEntry = ""


@strict
@dataclass(frozen=True)
class Answers:
    """Answers to `calib new` as texts and numbers; None if not answered.

    For the cell, "unknown" means not known and therefore not checked; "none" means that it does not exist.

    Attributes:
        robot: a .urdf, an MDH .toml, a library name, or the folder of an earlier fit.
        instrument: cmm, tracker, tracker6d, mocap, camera, camera-poses, other-pose, other-position, none.
        reference: a frame on the robot's base is measured beside the target, since instrument and base move against
            each other.
        tool: x,y,z: approximate position of the target in the tip's frame [m].
        limits: TOML file that describes the cell: instrument or [camera], obstacles, speeds; or
            MoveIt's files (calib formats moveit); none: asked in questions.
        mounting: in hand (the arm holds the camera), to hand (the arm holds the board), or unknown.
        lens: camera_info YAML with approximate values of the camera's lens; or unknown.
        board: board.toml as `calib board` writes it; or unknown.
        carried: placement of what the arm holds (camera or board) in the tip's frame [m]: 'x,y,z facing z'; or unknown.
        stands: placement of the fixed camera or board in the robot's base frame [m]: '0.5,0,0 facing z'; or unknown.
        instrument_at: x,y,z: position of the instrument in the robot's base frame [m]; unknown, or none.
        cone: half angle of the cone in which the target sees the instrument [deg] (a reflector: 30); or unknown.
        facing: direction that the target faces in the tip's frame: z, -x ….
        box: x,x,y,y,z,z: box around all parts of the arm, in its base frame [m]; unknown, or none.
        obstacles: 'table box 1.2,0.8,0.05 at 0.7,0,-0.03' [m]: shape, size, centre; unknown, or none; repeatable.
        dynamics: identify the dynamics, too (default), or fit the geometry only.
        torques: which torques the log contains.
        payloads: label=kg of a payload for additional recordings, or 'label=kg at x,y,z' with its centre of mass in
            the tip's frame [m]; label alone if its mass is unknown; repeatable (in an answer: between semicolons).
        goals: what the motion is for: torque (predict torques), parameters (small σ of parameters), or goals such as
            raw=35 (condition number), wrist=0.1 (mean torque as a share of its limit), coverage=0.1; repeatable (in an
            answer: between spaces); none: the best condition numbers.
        period: of the motion [s].
        front: number of trade-offs between condition number and torque goal to choose from; 0: none.
        tolerance_mm: largest accepted rms of the position on unseen poses [mm]; 0: none.
        tolerance_percent: largest accepted torque error of the exported robot on unseen motion [%]; 0: none.
        tolerance_torque: largest accepted rms torque error of each joint on unseen motion [N m or N]: one number for
            all joints, or one per joint with commas (0: none); none.
        program: controller in whose language the poses are written, too: ur, krl … (calib program --list); or none.
        details: ask for the certificate's details: number, serial numbers, operator ….
        certificate: these details.
    """

    robot: Text | None = None
    instrument: Text | None = None
    reference: Annotated[bool, Typed("--reference/--no-reference")] | None = None
    tool: Annotated[tuple[Held, Held, Held], Expect("x,y,z in metres, at most 3 m from the flange")] | None = None
    limits: Path | None = None
    mounting: Text | None = None
    lens: Text | None = None
    board: Text | None = None
    carried: Text | None = None
    stands: Text | None = None
    instrument_at: Text | None = None
    cone: Text | None = None
    facing: Text | None = None
    box: Text | None = None
    obstacles: tuple[str, ...] | None = None
    dynamics: Annotated[bool, Typed("--dynamics/--geometry-only")] | None = None
    torques: Torques | None = None
    payloads: tuple[str, ...] = ()
    goals: tuple[str, ...] = ()
    period: Annotated[float, Real(above=0.0, most=3600.0, unit="s")] | None = None
    front: Annotated[int, Whole(0, 1000)] | None = None
    tolerance_mm: Tolerance | None = None
    tolerance_percent: Tolerance | None = None
    tolerance_torque: Text | None = None
    program: Text | None = None
    details: Annotated[bool, Typed("--details/--no-details")] | None = None
    certificate: CertificateSection = field(default_factory=CertificateSection)

    @property
    def cell(self) -> dict[str, str | tuple[str, ...]]:
        """Answers about the measuring cell: option name -> answer; unanswered questions are absent."""
        return {name: value for name in CELL if (value := getattr(self, name)) is not None}
