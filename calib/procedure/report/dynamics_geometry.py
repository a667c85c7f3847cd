"""What geometry and dynamics say about each other: part of the report section on the dynamics."""

from collections.abc import Sequence

import numpy as np

from calib.errors import listing
from calib.procedure.dynamic_stage import geometry_tables
from calib.procedure.dynamic_stage.metrics import ModelMetrics
from calib.procedure.dynamic_stage.with_geometry import GeometryFromTorquesMetrics
from calib.procedure.report import page
from calib.units import small

# number of geometric errors, and of parameters, that are listed (our choice)
MAX_EFFECTS = 8
# change of a parameter [σ] from which on it counts as changed (our choice)
SIGNIFICANT = 2.0


def joint_blocks(jointly: GeometryFromTorquesMetrics | None) -> list[page.Block]:
    """Return what torques say about the geometry: the elements that they determine, before and after; empty: nothing.

    Args:
        jointly: geometry estimated together with the dynamics; None: not requested.
    """
    if jointly is None:
        return []
    determined = [change for change in jointly.elements if change.identified]
    resting = [change.element for change in jointly.elements if not change.identified]
    state = "the robot has the geometry from poses and torques" if jointly.delivered else "the geometry is unchanged"
    lines = [
        f"{state}: squared error of held-out torques {jointly.held_out:.4g} times that of the two stages",
        f"torques determine {jointly.combinations} combinations of {len(jointly.elements)} elements; offsets of the "
        "first and the last joint are not identifiable",
    ]
    poses = jointly.poses
    if poses is not None:
        lines.append(
            f"{poses.poses} held-out poses of the fit: {1e3 * poses.before:.4f} mm rms before the torques, "
            f"{1e3 * poses.after:.4f} mm after"
        )
    if resting:
        lines.append(f"determined by poses or their prior rather than by torques: {listing(resting, 8)}")
    rows = []
    for change in determined:
        before = f"{1e3 * change.sigma_before:.3g}"
        after = f"{1e3 * change.sigma_after:.3g}"
        shift = f"{1e3 * change.change:+.3g}"
        sigmas = f"{change.change / change.sigma_after:+.2g}"
        rows.append([change.element, f"m{change.unit}", shift, before, after, sigmas])
    blocks: list[page.Block] = [page.Text("Geometry from torques", lines)]
    if rows:
        header = ("element", "unit", "change", "σ before", "σ after", "change / σ after")
        blocks.append(page.ReportTable("Elements that torques determine", header, rows, numbers=[2, 3, 4, 5]))
    return blocks


def geometry_blocks(metrics: ModelMetrics, effects: Sequence[geometry_tables.GeometricEffect]) -> list[page.Block]:
    """Return the summary of how geometric errors affect the dynamic parameters, and a table of the largest effects."""
    geometry = metrics.geometry
    if geometry is None:
        return []
    lines = [geometry.summary]
    tilt = geometry.moved_by_1_mrad_of_tilt
    jointly = metrics.geometry_from_torques
    includes_tilt = jointly is not None and jointly.delivered
    if geometry.propagated and not includes_tilt and tilt.sigmas > geometry_tables.MIN_SHIFT:
        lines.append(
            f"a tilt of the base is not included: 1 mrad against gravity would change {tilt.parameter} by "
            f"{tilt.sigmas:.2g} of its sigma of torque noise"
        )
    blocks: list[page.Block] = [page.Text("Geometry and dynamics", lines)]
    relevant = [effect for effect in effects if effect.matters == "yes"]
    if geometry.changed and relevant:
        blocks.append(_effect_table(relevant[:MAX_EFFECTS]))
    return blocks


def comparison_blocks(rows: Sequence[geometry_tables.TwoGeometries]) -> list[page.Block]:
    """Return the table of the parameters that the calibrated geometry changes most, in σ; empty for one geometry."""
    if not rows:
        return []
    with_sigma = [row for row in rows if row.sigma_calibrated > 0.0]
    changes = np.array([(row.calibrated - row.nominal) / row.sigma_calibrated for row in with_sigma])
    table = []
    for k in np.argsort(-np.abs(changes), kind="stable")[:MAX_EFFECTS]:
        row = with_sigma[k]
        nominal = f"{row.nominal:.4g} ± {row.sigma_nominal:.2g}"
        calibrated = f"{row.calibrated:.4g} ± {row.sigma_calibrated:.2g}"
        table.append([row.name, row.unit, nominal, calibrated, f"{changes[k]:.2g} σ", row.essential])
    count = int(np.sum(np.abs(changes) > SIGNIFICANT))
    note = (
        f"{count} of {len(rows)} parameters change by more than {SIGNIFICANT:g} σ between the nominal and the "
        "calibrated geometry, identified from the same torques; all: geometries.csv."
    )
    header = ("parameter", "unit", "nominal geometry", "calibrated geometry", "change", "essential")
    title = "What the calibrated geometry changed in the dynamics"
    return [page.ReportTable(title, header, table, note, numbers=[2, 3, 4])]


def _effect_table(effects: Sequence[geometry_tables.GeometricEffect]) -> page.ReportTable:
    """Return the table of geometric errors, with the parameter that each shifts most, and the effect on the torque."""
    header = (
        "geometric error",
        "sigma",
        "moves most",
        "shift [its σ of torque noise]",
        "parameters moved",
        "torque rms [N m]",
    )
    rows = []
    for effect in effects:
        sigma = small(effect.sigma or 0.0, effect.unit)
        shift, count = f"{effect.shift_sigma:.2f}", str(effect.parameters_moved)
        torque = f"{effect.torque_rms or 0.0:.2g}"
        rows.append([effect.element, sigma, effect.parameter, shift, count, torque])
    return page.ReportTable("Which geometric errors matter for the dynamics", header, rows, numbers=[1, 3, 4, 5])
