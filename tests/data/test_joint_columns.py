"""Joint columns are told by the joint's name or number and the words beside it."""

import numpy as np
import pytest

from calib.data.csv_table import Table
from calib.data.joint_columns import (
    joint_series,
    joints_in,
    mapping_line,
    position_series,
    series_named_in_cells,
    words_of,
)

UR = ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint")
SO = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
SIX = tuple(f"joint_{number}" for number in range(1, 7))
OTHERS = ("x", "y", "z", "x1", "y1", "z1", "time", "temp1", "tau1", "i1")


def columns_read(header, joints, kinds=()):
    """Return the columns of the only series that may be positions."""
    (series,) = position_series(joint_series(header, joints, kinds))
    return series.columns


@pytest.mark.parametrize(
    "form",
    [
        "A{}",
        "a{}",
        "J{}",
        "JT{}",
        "Joint{}",
        "joint {}",
        "theta{}",
        "θ{}",
        "rax_{}",
        "Achse{}",
        "Gelenk {} (Ist)",
        "Eje {}",
        "关节{}",
        "field.position{}",
        "axis[{}]",
        "Joint{}Angle",
        "actual_q_{}",
        "J{} pos",
        "Axe-{}",
    ],
)
@pytest.mark.parametrize("first", [0, 1])
def test_numbered_joints_in_any_order_of_columns(form, first):
    names = [form.format(number) for number in range(first, first + 6)]
    shuffled = np.random.default_rng(0).permutation(names).tolist()
    assert columns_read((*OTHERS[:3], *shuffled, *OTHERS[3:]), SIX) == tuple(names)


@pytest.mark.parametrize(
    "form", ["{}.pos", "{}_position", "observation.state.{}.pos", "/joint_states/{}/position", "{} (deg)", "POS_{}"]
)
@pytest.mark.parametrize("joints", [UR, SO])
def test_joints_by_their_names_and_words_beside(form, joints):
    names = [form.format(joint) for joint in joints]
    speeds = [form.replace("position", "velocity").format(joint) for joint in joints if "position" in form]
    assert columns_read([*speeds, *reversed(names), "gripper.pos"], joints) == tuple(names)


def test_names_without_the_word_joint_and_pendant_names():
    assert columns_read(["elbow", "shoulder_pan", "shoulder_lift", "wrist_1", "wrist_2", "wrist_3"], UR)[0] == (
        "shoulder_pan"
    )
    assert columns_read(["Base", "Shoulder", "Elbow", "Wrist 1", "Wrist 2", "Wrist 3"], SIX)[3] == "Wrist 1"
    assert columns_read(list("SLURBT"), SIX) == tuple("SLURBT")


def test_external_axis_is_the_sliding_joint():
    kinds = ("prismatic", *("revolute",) * 6)
    arm = [f"A{number}" for number in range(1, 7)]
    assert columns_read([*arm, "E1", "X"], ("rail", *SIX), kinds) == ("E1", *arm)
    assert not position_series(joint_series([*arm, "E1"], ("rail", *SIX), ("revolute",) * 7))


def test_commanded_and_other_quantities_are_not_positions():
    measured = [f"J{number} actual" for number in range(1, 7)]
    commanded = [f"J{number} target" for number in range(1, 7)]
    assert columns_read([*commanded, *measured], SIX) == tuple(measured)
    for quantity in ("temp", "tau", "velocity", "current"):
        header = [f"{quantity} J{number}" for number in range(1, 7)]
        assert not position_series(joint_series(header, SIX))
    two = [f"{word}{number}" for word in ("J", "theta") for number in range(1, 7)]
    assert len(position_series(joint_series(two, SIX))) == 2


def test_names_in_cells_give_the_order():
    order = (2, 0, 1)
    joints = ("a", "b", "c")
    header, cells = [], []
    for number, joint in enumerate(order):
        header += [f"field.name{number}", f"field.position{number}"]
        cells += [np.array([joints[joint]] * 4, dtype=object), np.full(4, float(joint))]
    table = Table("log.csv", tuple(header), ("",) * len(header), tuple(cells), np.arange(1, 5))
    series = position_series(series_named_in_cells(table, joints))
    assert [entry.columns for entry in series] == [("field.position1", "field.position2", "field.position0")]


def test_words_and_lines():
    assert words_of("Joint1.pos") == ("joint", "1", "pos")
    assert words_of("jointAngle₂") == ("joint", "angle", "2")
    assert joints_in(["left_joint_1.pos", "x"], ["left_joint_1", "right_joint_1"]) == ["left_joint_1"]
    (series,) = joint_series(["M1", "M2"], ("a", "b"))
    assert not series.is_position
    assert mapping_line(series) == 'columns = { q1 = "M1", q2 = "M2" }'
