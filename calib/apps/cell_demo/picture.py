"""The demonstration in one picture: the cell with its position errors, their histogram, and one joint's torque."""

from dataclasses import replace

import numpy as np

from calib import files
from calib.apps.cell_demo.step_lines import PICTURE
from calib.toolkit.report_charts import (
    AFTER,
    BEFORE,
    BROWN,
    INK,
    QUIET,
    Chart,
    Label,
    Line,
    Panel,
    drawn_chart,
    error_histogram,
)
from calib.toolkit.report_pages import read_fit_report
from calib.toolkit.result_folders import drawn, prediction, skeleton
from calib.toolkit.sessions import Session, chain_of, position_errors, torque_error

# from where the cell is seen
AZIMUTH, ELEVATION = np.deg2rad([-60.0, 20.0])
# [in]
HEIGHT = 2.5


def draw(session: Session, form: str) -> None:
    """Draw the picture of a finished session into its folder, as ``png`` or ``svg`` (`form`)."""
    panels = [_cell(session), _errors(session)]
    if session.dynamic:
        panels.append(_torque(session))
    chart = Chart(panels, HEIGHT, len(panels))
    files.write(session.path(PICTURE).with_suffix(f".{form}"), drawn_chart(chart, form))


def _seen_from(points: np.ndarray) -> np.ndarray:
    """Return points (..., 3) [m] projected onto the picture: (..., 2) [m], rightwards and upwards."""
    cos_azimuth, sin_azimuth = np.cos(AZIMUTH), np.sin(AZIMUTH)
    cos_elevation, sin_elevation = np.cos(ELEVATION), np.sin(ELEVATION)
    right = [-sin_azimuth, cos_azimuth, 0.0]
    up = [-sin_elevation * cos_azimuth, -sin_elevation * sin_azimuth, cos_elevation]
    return points @ np.array([right, up]).T


def _cell(session: Session) -> Panel:
    """Return the panel with a session's arm at one pose and the enlarged errors at all poses.

    Errors before and after calibration are drawn.
    """
    chain = chain_of(session)
    (measured,) = drawn(session.folder).measured
    scale = measured.arrow_scale(chain)
    # the pose that reaches farthest to the side and up
    arms = _seen_from(skeleton(chain, measured.q))
    tips = arms[:, -1]
    farthest = int(np.argmax(tips[:, 1] + np.abs(tips[:, 0])))
    x, y = arms[farthest].T
    layers = [Line(x, y, colour=QUIET, width=5.0), Line(x, y, "o", colour=INK, size=4.0)]
    for points, colour in ((measured.nominal, BEFORE), (measured.calibrated, AFTER)):
        # strokes from the measured points, with a gap behind each
        ends = measured.seen + scale * (points - measured.seen)
        gaps = np.full((len(ends), 2), np.nan)
        strokes = np.stack([_seen_from(measured.seen), _seen_from(ends), gaps], axis=1)
        x, y = strokes.reshape(-1, 2).T
        layers.append(Line(x, y, colour=colour, width=1.4))
    return Panel(layers, f"{len(measured.q)} poses, errors × {scale:g}", "[m]", "[m]", equal=True, ticks=5)


def _errors(session: Session) -> Panel:
    """Return the histogram of a session's position errors at held-out poses.

    It shows the errors of the nominal robot and of ``robot.urdf``.
    """
    sets = read_fit_report(session.validation.report).sets
    (unseen,) = (rows for rows in sets if rows.unseen)
    nominal = np.array(unseen.nominal["position"])
    urdf = np.array((unseen.urdf_alone or unseen.calibrated)["position"])
    before, after = position_errors(session) or (np.nan, np.nan)
    panel = error_histogram(nominal, urdf).panels[0]
    return replace(panel, title=f"unseen poses: {before:.2f} → {after:.2f} mm")


def _torque(session: Session) -> Panel:
    """Return the panel of measured torque, predicted torque and residual on a session's held-out motion.

    It shows the joint with the largest torque.
    """
    unseen = session.identification.unseen.read()
    curves = unseen.curves[0]
    t = np.array(curves.t, dtype=float).T
    measured = np.array(curves.measured, dtype=float).T
    predicted = np.array(curves.predicted, dtype=float).T
    joint = int(np.argmax(np.linalg.norm(measured, axis=0)))
    measured, predicted = measured[:, joint], predicted[:, joint]
    low, high = measured.min(), measured.max()

    layers = []
    label_height = high + 0.1 * (high - low)
    for name, share, values, colour, width in (
        ("measured", 0.03, measured, BROWN, 1.6),
        ("predicted", 0.38, predicted, AFTER, 0.8),
        ("residual", 0.7, measured - predicted, QUIET, 0.6),
    ):
        label_time = t[0] + share * (t[-1] - t[0])
        layers.append(Line(t, values, colour=colour, width=width))
        layers.append(Label(name, label_time, label_height, (0, 0), colour))

    error = torque_error(session)
    title = f"{error:.1f} % of torque unexplained"
    outcome = prediction(session.path(session.export))
    if outcome is not None:
        # of the exported robot, in brackets of the identified model
        title = f"{outcome.exported:.1f} % ({error:.1f} %) unexplained"
    y_label = f"{unseen.rows[joint]} [{unseen.units[joint]}]"
    x_limits, y_limits = (t[0], t[-1]), (1.1 * low, 1.1 * label_height)
    return Panel(layers, title, "unseen motion [s]", y_label, xlim=x_limits, ylim=y_limits)
