"""A joint that moves in proportion farther than its readings is named: a rail's scale in ppm, a gear's ratio."""

from dataclasses import replace

import planted
import pytest

from calib.geometry.fit import fit
from calib.procedure.findings import sentence
from calib.procedure.kinematic_stage.verdict.plausibility import joint_scales
from calib.robot.calibrated import Deflection, Term
from calib.robot.chain import Chain
from calib.robot.formats import urdf
from calib.robot.formats.urdf_write import write_new
from calib.robot.library import load

RAIL = (
    '<link name="floor"/><joint name="track" type="prismatic"><parent link="floor"/><child link="base"/>'
    '<axis xyz="1 0 0"/><limit lower="-2" upper="2" velocity="1" effort="1"/></joint></robot>'
)


@pytest.fixture(scope="module")
def arm() -> Chain:
    """A UR5 on a rail of 4 m."""
    return urdf.parse(write_new(load("ur5")).replace("</robot>", RAIL), "rail.urdf", "floor")


@pytest.mark.parametrize(("source", "scale", "code"), [(0, 3e-4, "rail-scale"), (3, 1e-2, "gear-scale")])
def test_scale_of_a_joint_is_named(arm, source, scale, code):
    """The planted scale of a rail or a gear is named within its σ; without one nothing is."""
    terms = tuple(Term(arm.names[arm.moving[joint]], "joint", joint) for joint in (source, 1))
    cell = planted.cell(arm)
    start = replace(cell, deflection=Deflection(terms, (0.0, 0.0), arm))
    truth = replace(start, deflection=start.deflection.with_coefficients((scale, 0.0)))
    (found,) = joint_scales(fit(start, [planted.measure(truth, "position", 120, sigma=2e-5)]))
    assert (found.code, found.values["joint"]) == (code, arm.joint_names[source])
    assert abs(found.values["size"] - 1e6 * scale) < 5.0 * found.values["sigma"]
    assert f"{found.values['size']:+.0f} ± " in sentence(found)
    assert joint_scales(fit(start, [planted.measure(start, "position", 120, sigma=2e-5)])) == []
