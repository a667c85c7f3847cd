"""The tables of real_recordings.md, a row each: what the toolkit reaches on real recordings.

CALIB_DATA=... python examples/real_recordings.py [ROW ...]
"""

from __future__ import annotations

import argparse
import os
import tempfile
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import calib
from calib.procedure.export.delivery import prediction

DATA = Path(os.environ.get("CALIB_DATA", "../shared/data"))
WRIST = calib.IdentifySettings(coupling=({"joints": [5, 6], "label": "6"},))  # one motor moves axes 5 and 6


@dataclass(frozen=True)
class GeometryRow:
    """A row of the table of geometry: rms of the nominal arm, of robot.urdf and with joint corrections [mm].

    Attributes:
        document: how the document's row begins.
        robot: the description, below `DATA`.
        measured: the poses to fit, in the same folder.
        unseen: poses to judge on, whose frames are fitted anew; "": the share `holdout` of the poses to fit.
        holdout: share of the poses that is held out.
    """

    document: str
    robot: str
    measured: str
    unseen: str = ""
    holdout: float = 0.0

    unit = "mm"
    digits = 3

    def run(self) -> tuple[float, ...]:
        """Make the figures anew."""
        return geometry(DATA / self.robot, self.measured, self.unseen, self.holdout)


@dataclass(frozen=True)
class DynamicsRow:
    """A row of the table of dynamics: the torque that models leave unexplained [%].

    Attributes:
        document: how the document's row begins.
        train: the recording to learn from, below `DATA`.
        unseen: another motion, in the same folder.
        settings: of the identification.
        exported: whether the exported robot is judged, too.
    """

    document: str
    train: str
    unseen: str
    settings: calib.IdentifySettings | None = None
    exported: bool = False

    unit = "%"
    digits = 1

    def run(self) -> tuple[float, ...]:
        """Make the figures anew."""
        return dynamics(DATA / self.train, self.unseen, self.settings, self.exported)


def geometry(robot: Path, measured: str, unseen: str, holdout: float) -> tuple[float, ...]:
    """Return rms position errors [mm] on held-out rows: nominal arm, robot.urdf, and with joint corrections."""
    settings = calib.FitSettings(holdout=holdout, refit_frames=bool(unseen))
    unseen_files = []
    if unseen:
        unseen_files.append(robot.parent / unseen)
    fit = calib.fit_geometry(robot, robot.parent / measured, settings, validate=unseen_files)
    (validation,) = fit.validation.values()
    nominal, corrected = validation.errors
    delivered = validation.alone or corrected  # what robot.urdf holds, without joint corrections
    return rms_mm(nominal.main), rms_mm(delivered.main), rms_mm(corrected.main)


def rms_mm(errors: np.ndarray) -> float:
    """Return the rms [mm] of position errors (m,) [m]."""
    return 1e3 * float((errors**2).mean() ** 0.5)


def dynamics(train: Path, unseen: str, settings: calib.IdentifySettings | None, exported: bool) -> tuple[float, ...]:
    """Return the relative torque error [%] on a validation motion: identified model, in motion, exported robot.

    The second one where joints stand in that motion, the third one where it is asked for.
    """
    robot = train.parent / "model.urdf"
    model = calib.identify_dynamics(robot, str(train), settings, validate=str(train.parent / unseen))
    (validation,) = model.validation.values()
    figures = [validation.raw.total]
    if validation.stands:
        figures.append(validation.moving.total)
    if exported:
        figures.append(exported_error(model, robot))
    return tuple(figures)


def exported_error(model: calib.DynamicsModel, robot: Path) -> float:
    """Return the relative torque error [%] of the robot that `calib.export` writes."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a result that does not pass is exported with a warning
        calib.export(model, folder, urdf=robot)
        errors = prediction(Path(folder))
    if errors is None:
        raise ValueError(f"{robot}: the exported robot's torques are not known")
    return errors.exported


UR5 = "ur5_gts3800/model.urdf"
UR10 = "ur10_ipa/model.urdf"
UR10_A = "A_grid_2500.csv"
UR10_B = "B_joint_configurations.csv"
MOTOMAN = "motoman_leica/model_right.urdf"
PANDA = "traj1_first60pct.npz"
TX40 = "tx40_first_5p4s.npz"
KR300_A = "traj_A.npz"
KR300_B = "traj_B.npz"
ROWS = (
    GeometryRow("UR5 (GTS3800", UR5, "grid_800.csv", holdout=0.25),
    GeometryRow("UR10 (IPA), A", UR10, UR10_A, holdout=0.4),
    GeometryRow("UR10, fitted on A", UR10, UR10_A, UR10_B),
    GeometryRow("UR10, fitted on B", UR10, UR10_B, UR10_A),
    GeometryRow("Motoman, 6 x 6 x 6", MOTOMAN, "right_6x6x6_150.csv", holdout=1 / 3),
    GeometryRow("Motoman, wide", MOTOMAN, "right_wide_386.csv", holdout=0.25),
    DynamicsRow("Panda (INRIA)", f"franka_panda_inria/{PANDA}@0:9.387", f"{PANDA}@9.387:", exported=True),
    DynamicsRow("TX40 (figaroh", f"staubli_tx40/{TX40}@0:4", f"{TX40}@4:", WRIST),
    DynamicsRow("KR300 (TUK), A", f"kuka_kr300_tuk/{KR300_A}", KR300_B),
    DynamicsRow("KR300 (TUK), B", f"kuka_kr300_tuk/{KR300_B}", KR300_A),
    DynamicsRow("TIAGo (LAAS)", "tiago_laas/dynamic.npz@0:50", "dynamic.npz@50:"),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("rows", nargs="*", help="how rows of the document begin; all without any")
    beginnings = parser.parse_args().rows
    for row in ROWS:
        if not beginnings or row.document.startswith(tuple(beginnings)):
            figures = [f"{value:.{row.digits}f} {row.unit}" for value in row.run()]
            print(f"| {row.document} | {' | '.join(figures)} |", flush=True)


if __name__ == "__main__":
    main()
