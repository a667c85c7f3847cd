"""The tables of real_recordings.md, a row each: what the toolkit reaches on real recordings.

CALIB_DATA=... python examples/real_recordings.py [ROW ...]
"""

from __future__ import annotations

import argparse
import os
import tempfile
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import calib
from calib.data.poses.fit_options import FitOptions
from calib.identification.identify_options import parse_options
from calib.procedure.export.delivery import prediction
from calib.procedure.kinematic_stage import fit, inputs
from calib.procedure.kinematic_stage.settings import FitSettings

DATA = Path(os.environ.get("CALIB_DATA", "../shared/data"))
WRIST = {"coupling": [{"joints": [5, 6], "label": "6"}]}


@dataclass(frozen=True)
class Row:
    """One row of a table.

    Attributes:
        document: how the document's row begins.
        run: makes the figures anew: rms of the nominal arm, of robot.urdf and with joint corrections [mm], or the
            torque that is unexplained by the identified model and, where stated, by the exported robot [%].
        unit: of them.
    """

    document: str
    run: Callable[[], tuple[float, ...]]
    unit: str


def geometry(folder: str, robot: str, measured: str, unseen: str = "", holdout: float = 0.0) -> tuple[float, ...]:
    """Return rms position errors [mm] on held-out rows: nominal arm, robot.urdf, and with joint corrections."""
    place = DATA / folder
    wanted = FitSettings(holdout=holdout, refit_frames=bool(unseen))
    others = [place / unseen] if unseen else []
    given = inputs.gather(place / robot, [place / measured], others, settings=wanted)
    (found,) = fit.run(given, FitOptions(), wanted).validation.values()
    nominal, corrected = found.errors
    arms = (nominal, found.alone or corrected, corrected)
    return tuple(1e3 * float((arm.main**2).mean() ** 0.5) for arm in arms)


def dynamics(
    folder: str, train: str, unseen: str, options: dict | None = None, exported: bool = False
) -> tuple[float, ...]:
    """Return the relative torque error [%] on a validation motion: identified model, in motion, exported robot.

    The second one where joints stand in that motion, the third one where it is asked for.
    """
    robot = DATA / folder / "model.urdf"
    read = parse_options(options or {})
    training, validation = str(DATA / folder / train), str(DATA / folder / unseen)
    model = calib.identify_dynamics(robot, training, validate=validation, options=read)
    (found,) = model.validation.values()
    figures = (found.raw.total, found.moving.total) if found.stands else (found.raw.total,)
    if not exported:
        return figures
    with tempfile.TemporaryDirectory() as place, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a result that does not pass is exported with a warning
        calib.export(model, place, urdf=robot)
        errors = prediction(Path(place))
    if errors is None:
        raise ValueError(f"{folder}: the exported robot's torques are not known")
    return *figures, errors.exported


PANDA, TX40, TIAGO = "traj1_first60pct.npz", "tx40_first_5p4s.npz", "dynamic.npz"
ROWS = (
    Row("UR5 (GTS3800", lambda: geometry("ur5_gts3800", "model.urdf", "grid_800.csv", holdout=0.25), "mm"),
    Row("UR10 (IPA), A", lambda: geometry("ur10_ipa", "model.urdf", "A_grid_2500.csv", holdout=0.4), "mm"),
    Row(
        "UR10, fitted on A",
        lambda: geometry("ur10_ipa", "model.urdf", "A_grid_2500.csv", "B_joint_configurations.csv"), "mm",
    ),
    Row(
        "UR10, fitted on B",
        lambda: geometry("ur10_ipa", "model.urdf", "B_joint_configurations.csv", "A_grid_2500.csv"), "mm",
    ),
    Row(
        "Motoman, 6 x 6 x 6",
        lambda: geometry("motoman_leica", "model_right.urdf", "right_6x6x6_150.csv", holdout=1 / 3), "mm",
    ),
    Row(
        "Motoman, wide",
        lambda: geometry("motoman_leica", "model_right.urdf", "right_wide_386.csv", holdout=0.25), "mm",
    ),
    Row(
        "Panda (INRIA)",
        lambda: dynamics("franka_panda_inria", f"{PANDA}@0:9.387", f"{PANDA}@9.387:", exported=True), "%",
    ),
    Row("TX40 (figaroh", lambda: dynamics("staubli_tx40", f"{TX40}@0:4", f"{TX40}@4:", WRIST), "%"),
    Row("KR300 (TUK), A", lambda: dynamics("kuka_kr300_tuk", "traj_A.npz", "traj_B.npz"), "%"),
    Row("KR300 (TUK), B", lambda: dynamics("kuka_kr300_tuk", "traj_B.npz", "traj_A.npz"), "%"),
    Row("TIAGo (LAAS)", lambda: dynamics("tiago_laas", f"{TIAGO}@0:50", f"{TIAGO}@50:"), "%"),
)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("rows", nargs="*", help="how rows of the document begin; all without any")
    wanted = parser.parse_args().rows
    for row in ROWS:
        if not wanted or any(row.document.startswith(one) for one in wanted):
            figures = " | ".join(
                f"{value:.3f} {row.unit}" if row.unit == "mm" else f"{value:.1f} %" for value in row.run()
            )
            print(f"| {row.document} | {figures} |", flush=True)


if __name__ == "__main__":
    main()
