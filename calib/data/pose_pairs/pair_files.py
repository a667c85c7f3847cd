"""Reading of files with pairs of poses, whatever their format."""

from pathlib import Path

from calib.data.pose_pairs.pair_tables import read_table_of_pairs
from calib.data.pose_pairs.pair_trees import SUFFIXES, read_pairs_of_tree
from calib.data.pose_pairs.poses import PosePairs
from calib.data.poses.fit_options import FileOptions
from calib.errors import MeasurementError

# Characters with which the content of a tree begins, whatever the file's name.
MARKS = (b"%YAML", b"<?xml", b"<opencv", b"{", b"samples:", b"- ")


def read_pairs(path: str | Path, options: FileOptions | None = None) -> PosePairs | None:
    """Return the pairs of poses in a file; None for a table with joints, or with other measurements.

    Args:
        path: the file.
        options: column names, units and conventions that the file does not state.

    Raises:
        MeasurementError: the file cannot be read; it is YAML, JSON or XML without pairs of poses.
    """
    path = Path(path)
    if path.is_dir() or not path.is_file():
        return None
    with path.open("rb") as file:
        begin = file.read(64).lstrip(b"\xef\xbb\xbf \t\r\n")
    if path.suffix.lower() in SUFFIXES or begin.startswith(MARKS):
        pairs = read_pairs_of_tree(path)
        if pairs is None:
            raise MeasurementError(
                "has no pairs of poses: expected samples with two poses each (robot and board), or two lists of poses, "
                "such as R_gripper2base, t_gripper2base, R_target2cam, t_target2cam",
                path,
            )
        return pairs
    return read_table_of_pairs(path, options or FileOptions())
