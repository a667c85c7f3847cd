"""The demonstration in one picture: the cell with its errors, their histogram, and the torque of one joint."""

from dataclasses import replace

import numpy as np

from calib import files
from calib.apps.cell_demo.summary import PICTURE
from calib.procedure.export.delivery import prediction
from calib.procedure.report import fit_report
from calib.procedure.report.charts import Chart, Panel, line, picture, text
from calib.procedure.report.geometry_figures import error_histogram
from calib.procedure.report.style import AFTER, BEFORE, BROWN, INK, QUIET
from calib.procedure.session.folder import Session
from calib.procedure.session.geometry_steps import chain_of
from calib.procedure.session.results import position_errors, torque_error
from calib.toolkit.opened_results import drawn, skeleton

AZIMUTH, ELEVATION = np.deg2rad([-60.0, 20.0])  # from where the cell is seen
HEIGHT = 2.5  # [in]


def draw(session: Session) -> None:
    """Draw the picture of a finished session into its folder."""
    panels = [_cell(session), _errors(session)]
    if session.dynamic:
        panels.append(_torque(session))
    files.write(session.path(PICTURE), picture(Chart(panels, HEIGHT, len(panels)), "").image)


def _seen_from(points: np.ndarray) -> np.ndarray:
    """Return points (..., 3) [m] as seen from afar: (..., 2), to the right and up."""
    (c, s), (ce, se) = ((np.cos(angle), np.sin(angle)) for angle in (AZIMUTH, ELEVATION))
    return points @ np.array([[-s, c, 0.0], [-se * c, -se * s, ce]]).T


def _cell(session: Session) -> Panel:
    """Return the arm at one of its poses, and the errors at all poses before and after, enlarged."""
    (measured,), chain = drawn(session.folder).measured, chain_of(session)
    scale, arm = measured.arrow_scale(chain), _seen_from(skeleton(chain, measured.q))
    x, y = arm[int(np.argmax(arm[:, -1, 1] + np.abs(arm[:, -1, 0])))].T
    layers = [line(x, y, colour=QUIET, width=5.0), line(x, y, "o", colour=INK, size=4.0)]
    for points, colour in ((measured.nominal, BEFORE), (measured.calibrated, AFTER)):
        ends = measured.seen + scale * (points - measured.seen)
        strokes = np.stack([_seen_from(measured.seen), _seen_from(ends), np.full((len(ends), 2), np.nan)], axis=1)
        layers.append(line(strokes[..., 0].ravel(), strokes[..., 1].ravel(), colour=colour, width=1.4))
    return Panel(layers, f"{len(measured.q)} poses, errors × {scale:g}", "[m]", "[m]", equal=True, ticks=5)


def _errors(session: Session) -> Panel:
    """Return the histogram of the errors of nominal robot and robot.urdf on unseen poses."""
    (rows,) = (rows_set for rows_set in fit_report.read(session.validation.report).sets if rows_set.unseen)
    nominal = np.array(rows.nominal["position"])
    urdf = np.array((rows.urdf_alone or rows.calibrated)["position"])
    before, after = position_errors(session) or (np.nan, np.nan)
    return replace(error_histogram(nominal, urdf).panels[0], title=f"unseen poses: {before:.2f} → {after:.2f} mm")


def _torque(session: Session) -> Panel:
    """Return the largest joint's torque on the unseen motion: measured, predicted, residual."""
    unseen = session.identification.unseen.read()
    curves = unseen.curves[0]
    t = np.array(curves.t, dtype=float).T
    measured = np.array(curves.measured, dtype=float).T
    predicted = np.array(curves.predicted, dtype=float).T
    j = int(np.argmax(np.linalg.norm(measured, axis=0)))
    low, high = measured[:, j].min(), measured[:, j].max()
    above = high + 0.1 * (high - low)
    layers = []
    for name, at, values, colour, width in (
        ("measured", 0.03, measured, BROWN, 1.6),
        ("predicted", 0.38, predicted, AFTER, 0.8),
        ("residual", 0.7, measured - predicted, QUIET, 0.6),
    ):
        layers.append(line(t, values[:, j], colour=colour, width=width))
        layers.append(text(name, t[0] + at * (t[-1] - t[0]), above, (0, 0), colour))
    title, y = f"{torque_error(session):.1f} % of torque unexplained", f"{unseen.rows[j]} [{unseen.units[j]}]"
    outcome = prediction(session.path(session.export))
    if outcome is not None:
        # of the exported robot, in brackets of the identified model
        title = f"{outcome.exported:.1f} % ({torque_error(session):.1f} %) unexplained"
    return Panel(layers, title, "unseen motion [s]", y, xlim=(t[0], t[-1]), ylim=(1.1 * low, 1.1 * above))
