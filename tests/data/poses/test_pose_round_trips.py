"""Joint and file names of any kind survive the tables they are written to."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from strategies import column_names

from calib import files
from calib.data.csv_table import read_table
from calib.data.poses.pose_lists import read_poses, write_poses


@given(st.lists(column_names(), min_size=1, max_size=6, unique=True), st.integers(0, 9))
def test_planned_poses_come_back(tmp_path_factory, joints, seed):
    q = np.random.default_rng(seed).uniform(-1.0, 1.0, (4, len(joints)))
    path = write_poses(tmp_path_factory.mktemp("plan") / "poses.csv", q, joints)
    np.testing.assert_allclose(read_poses(path, joints), q, rtol=1e-11, atol=0.0)


@given(
    st.lists(column_names(), min_size=2, max_size=5, unique=True),
    st.lists(st.floats(-1e6, 1e6).map(lambda x: float(f"{x:.12g}")), min_size=1, max_size=4),
)
def test_a_table_returns_its_cells(tmp_path_factory, header, values):
    rows = [[value] * len(header) for value in values]
    table = read_table(files.write_table(tmp_path_factory.mktemp("table") / "t.csv", header, rows))
    for name in header:
        assert table.numbers(name).tolist() == values
