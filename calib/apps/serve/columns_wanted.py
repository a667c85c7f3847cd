"""The columns that a served session wants in each kind of file, with an example."""

from dataclasses import dataclass

import numpy as np

from calib.errors import CalibError
from calib.toolkit.chains import Chain, forward
from calib.toolkit.pose_data import IMAGES, read_poses
from calib.toolkit.result_folders import joints_of
from calib.toolkit.sessions import POSES, Session, chain_of, measured_columns, recorded_columns
from calib.transforms import to_quaternion
from calib.units import JOINT

# rows of an example
ROWS = 3
# rate of an example's log [Hz]
RATE = 500.0
APART = (
    "Or joint values and points in files apart, in any format that calib join reads: upload both, and they are "
    "joined here. Joint values: a CSV, or what the controller kept (POSREG.VA, .dat, .script …); points: a CSV, or an "
    "instrument's text export (SpatialAnalyzer, Motive, Vicon …). Names, times, order, or the nominal arm pair them. "
    "Columns with other names are asked for."
)
WITH_IMAGES = (
    "Images of the board, joints.csv (a row per image: its file name and joint values), board.toml (calib board "
    "makes boards), and camera.yaml if the lens is known: choose all of them at once."
)
OTHERS = (
    "Other formats of logs: .npz, .mcap, .bag, .db3, a controller's own log as .csv. Positions in one .csv and torques "
    "or currents in another, with times of one clock: upload both, and they are joined here."
)


@dataclass(frozen=True)
class Example:
    """Columns that a kind of file has, a few rows as they may look (joint values are planned ones), and remarks."""

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    remark: str

    @property
    def text(self) -> str:
        """The example as the text of a CSV file."""
        lines = map(",".join, (self.header, *self.rows))
        return "\n".join(lines) + "\n"


def example_of(session: Session, kind: str) -> Example:
    """Return an example of a kind of file (a key of `BROUGHT`) for a session's robot and instrument."""
    chain = chain_of(session)
    q = _poses(session, chain)
    if kind in ("training", "unseen"):
        header = recorded_columns(session)
        rows = []
        for k in range(ROWS):
            joints = [f"{value:.4f}" for value in _shown(chain, q[0])]
            torques = ["0.0"] * (len(header) - 1 - chain.n)
            rows.append((f"{k / RATE:g}", *joints, *torques))
        return Example(tuple(header), tuple(rows), OTHERS)
    if session.settings.instrument.measures == IMAGES:
        joints = measured_columns(session)[: chain.n]
        rows = []
        for k, values in enumerate(q, 1):
            cells = [f"{value:.3f}" for value in _shown(chain, values)]
            rows.append((f"image_{k:02d}.png", *cells))
        return Example(("image", *joints), tuple(rows), WITH_IMAGES)

    header = measured_columns(session)
    rows = []
    for values, tip in zip(q, forward(chain, q)):
        cells = [f"{value:.3f}" for value in _shown(chain, values)]
        cells += [f"{value:.3f}" for value in 1e3 * tip[:3, 3]]
        turn = [f"{value:.6f}" for value in to_quaternion(tip)]
        if len(header) > len(cells):
            cells += turn
        # the frame on the base, where it is asked for
        while len(header) > len(cells):
            cells += ["0.000", "0.000", "0.000", "0.000000", "0.000000", "0.000000", "1.000000"]
        rows.append(tuple(cells[: len(header)]))
    return Example(tuple(header), tuple(rows), APART)


def _poses(session: Session, chain: Chain) -> np.ndarray:
    """Return some poses (k, n) [rad or m]: the first that are planned, or zeros."""
    path = session.path(f"2-poses/{POSES}")
    try:
        return read_poses(path, joints_of(chain))[:ROWS]
    except (CalibError, OSError):
        return np.zeros((ROWS, chain.n))


def _shown(chain: Chain, q: np.ndarray) -> list[float]:
    """Return joint values (n,) in the units in which they are shown: degrees and millimetres."""
    displayed = []
    for joint, value in zip(chain.joints, q):
        kind = "revolute"
        if joint.kind == "prismatic":
            kind = "prismatic"
        factor, _ = JOINT[kind]
        displayed.append(factor * float(value))
    return displayed
