"""Claims: corner tables and patterns are OpenCV's; prints are at true scale; a board that cannot be is refused."""

import re

import cv2
import numpy as np
import pytest

from calib.data.images.board import Board, corners, read_board, write_board
from calib.data.images.board_print import POINT, charuco, dictionary, page_size, pdf, raster, svg
from calib.errors import UsageError

BOARDS = {
    "charuco": Board("charuco", 9, 7, 0.03, 0.021),
    "apriltag": Board("apriltag", 6, 4, 0.03, 0.009, "apriltag_36h11"),
    "chessboard": Board("chessboard", 8, 5, 0.025),
}


@pytest.mark.parametrize("kind", ["charuco", "apriltag"])
def test_corners_and_pattern_are_opencvs(kind):
    board = BOARDS[kind]
    size, words = (board.columns, board.rows), dictionary(board.dictionary)
    theirs = charuco(board) if kind == "charuco" else cv2.aruco.GridBoard(size, board.square, board.marker, words)
    table = theirs.getChessboardCorners() if kind == "charuco" else np.concatenate(theirs.getObjPoints())
    assert corners(board) == pytest.approx(np.asarray(table), abs=1e-7)
    drawn = theirs.generateImage(tuple(round(4000 * length) for length in board.extent), marginSize=0)
    assert np.array_equal(raster(board, 4000.0, 0.0) < 0.5, drawn < 128)


@pytest.mark.parametrize("kind", BOARDS)
def test_prints_are_at_true_scale(kind):
    """The pattern's extent, and the ruler's length, in both files."""
    board = BOARDS[kind]
    size = page_size(board)
    boxes = np.array([[float(v) for v in row] for row in re.findall(
        r'<rect x="([\d.]+)" y="([\d.]+)" width="([\d.]+)" height="([\d.]+)"', svg(board, size))]) / 1e3  # fmt: skip
    ruler = boxes[boxes[:, 3] < 3e-4][-1]
    pattern = boxes[boxes[:, 1] + boxes[:, 3] < ruler[1] - 0.005]
    for axis in (0, 1):
        high = (pattern[:, axis] + pattern[:, axis + 2]).max() - pattern[:, axis].min()
        assert high == pytest.approx(board.extent[axis], abs=2e-7)
    assert ruler[2] - ruler[3] == pytest.approx(0.01 * int(100 * min(board.extent[0], 0.2) + 1e-9), abs=1e-6)
    page = pdf(board, size)
    box = [float(v) * POINT for v in re.search(rb"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", page).groups()]
    assert box == pytest.approx(size, abs=1e-6)
    rows = np.array([[float(v) for v in row.split()[:4]] for row in page.split(b"\n") if row.endswith(b" re")]) * POINT
    assert sorted(rows[:, 2].round(6)) == pytest.approx(sorted(boxes[:, 2].round(6)), abs=2e-6)
    assert b"/PrintScaling /None" in page


def test_a_board_is_written_and_read_back(tmp_path):
    for board in BOARDS.values():
        write_board(board, tmp_path / "board.toml")
        assert read_board(tmp_path) == board


@pytest.mark.parametrize(
    "text, words",
    [
        ('kind = "checker"', "expected one of charuco, chessboard, apriltag"),
        ("square = 30", "square: expected"),
        ("marker = 0.029", "between 0.3 and 0.9 of square"),
        ('kind = "chessboard"\ncolumns = 8\nrows = 6', "look the same upside down"),
        ("marker = 0.02\ncolumns = 30\nrows = 30", "450 markers are needed"),
        ("marker = 0.02\ncolums = 3", "did you mean 'columns'"),
    ],
)
def test_a_board_that_cannot_be_is_refused(text, words, tmp_path):
    (tmp_path / "board.toml").write_text(text)
    with pytest.raises(UsageError, match=words):
        read_board(tmp_path)


def test_board_larger_than_paper_is_refused():
    """A board larger than its paper is refused with what fits."""
    with pytest.raises(UsageError, match=r"larger than A4; squares of \d+ mm would fit"):
        page_size(BOARDS["charuco"], "a4")
    assert page_size(Board("charuco", 7, 5, 0.03, 0.021), "a4") in ((0.210, 0.297), (0.297, 0.210))
