"""Which board the markers in an image lie on, where it is not the one of ``board.toml``.

A board's markers are numbered row by row, so that the number of columns follows from where they are: of every number of
columns, that is taken whose flat board explains the markers' corners best (homography, RANSAC).
"""

import math
from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np

from calib.data.images.board import DICTIONARIES, Board
from calib.data.images.board_print import dictionary

# Smallest number of detected markers from which on a dictionary counts as that of the print.
MIN_MARKERS = 4
# Largest number of columns that is tried.
MAX_COLUMNS = 40
# Largest distance of a marker's corner from its prediction [px], as a share of the markers' sides.
MAX_ERROR = 0.25
# Largest number of samples of RANSAC: nearly all corners of the right layout agree.
MAX_ITERATIONS = 50
# The same where two markers may be exchanged: samples need four right corners.
EXCHANGE_ITERATIONS = 2000
# Smallest share of the corners that a layout has to explain.
MIN_SHARE = 0.9
# What differs from board.toml, in words.
EXCHANGED = "columns and rows are exchanged"
INNER = "squares are counted, not inner corners"
OLD_PATTERN = "the pattern is that of OpenCV before 4.6 (setLegacyPattern), which begins with a white square"


def has_two_patterns(board: Board) -> bool:
    """Return whether boards of this size differ between OpenCV before and from 4.6: ChArUco with even rows."""
    return board.kind == "charuco" and board.rows % 2 == 0


def other_dictionary(image: np.ndarray, board: Board) -> str:
    """Return the name of the dictionary with the most detected markers; "" if hardly any are detected."""
    family = board.dictionary.split("_")[0]
    counts = {}
    for name in DICTIONARIES:
        is_largest = name.endswith("_100") or name.startswith("apriltag_36h11")
        if is_largest and name.split("_")[0] != family:
            counts[name] = len(markers(image, name)[0])
    best = max(counts, key=counts.__getitem__)
    if counts[best] < MIN_MARKERS:
        return ""
    return best


def markers(image: np.ndarray, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers (n,) and corners (n, 4, 2) [px] of a dictionary's markers in an image."""
    detector = cv2.aruco.ArucoDetector(dictionary(name))
    pixels, ids, _ = detector.detectMarkers(image)
    if ids is None:
        return np.zeros(0, dtype=int), np.zeros((0, 4, 2))
    return ids.ravel(), np.concatenate(pixels)


def layout_words(image: np.ndarray, board: Board) -> str:
    """Return which board the markers in an image fit, as text; "" with too few markers of the board's dictionary.

    Args:
        image: (height, width) 8-bit grey.
        board: the board of ``board.toml``, on which the markers are not.
    """
    ids, pixels = markers(image, board.dictionary)
    if len(ids) < MIN_MARKERS:
        return ""
    count = f"{len(ids)} markers of {board.dictionary} are seen, but not where board.toml has them"
    for candidate, cause in _candidates(board):
        if candidate.tags > ids.max() and _explains(candidate, ids, pixels):
            values = f"columns = {candidate.columns}, rows = {candidate.rows}"
            if candidate.legacy:
                values += ", legacy = true"
            return f"{count}: {cause}; they fit {values}: state this in board.toml"
    squares = int(ids.max() + 1)
    # a marker in every other square
    if board.kind == "charuco":
        squares *= 2
    for columns in range(2, MAX_COLUMNS + 1):
        rows = math.ceil(squares / columns) + 1
        for legacy in (False, True):
            candidate = _sized(board, columns, rows + rows % 2, legacy)
            if columns != board.columns and _explains(candidate, ids, pixels):
                return (
                    f"{count}: they fit a board of {columns} columns (board.toml: {board.columns}): count its squares "
                    "across and down"
                )
    return f"{count}: are kind, columns and rows (squares, not inner corners) those of the print?"


def _candidates(board: Board) -> Iterator[tuple[Board, str]]:
    """Yield the boards that may be meant by a wrong ``board.toml``, with what is wrong, in words."""
    columns, rows = board.columns, board.rows
    sizes = (
        (columns, rows, ""),
        (rows, columns, EXCHANGED),
        (columns + 1, rows + 1, INNER),
        (rows + 1, columns + 1, f"{EXCHANGED}, and {INNER}"),
    )
    for legacy in (False, True):
        for width, height, difference in sizes:
            candidate = _sized(board, width, height, legacy)
            if legacy and not has_two_patterns(candidate):
                continue
            causes = [difference]
            if legacy:
                causes.append(OLD_PATTERN)
            yield candidate, ", and ".join(filter(None, causes))


def _sized(board: Board, columns: int, rows: int, legacy: bool) -> Board:
    """Return a board of another size and pattern, whatever number of markers its dictionary has."""
    result = replace(board)
    for name, value in (("columns", columns), ("rows", rows), ("legacy", legacy)):
        # not by replace, which checks the number of markers
        object.__setattr__(result, name, value)
    return result


def _explains(board: Board, ids: np.ndarray, pixels: np.ndarray) -> bool:
    """Return whether markers lie where a flat board has them.

    Args:
        board: the board.
        ids: (n,) numbers of the detected markers.
        pixels: (n, 4, 2) their corners [px].
    """
    corners = marker_corners(board, int(ids.max()) + 1)
    if len(corners) <= ids.max():
        return False
    points = corners[ids].reshape(-1, 2)
    corner_pixels = pixels.reshape(-1, 2).astype(float)
    sides = np.linalg.norm(pixels[:, 0] - pixels[:, 1], axis=1)
    tolerance = max(1.0, MAX_ERROR * float(np.median(sides)))
    plane, inliers = cv2.findHomography(points, corner_pixels, cv2.RANSAC, tolerance, maxIters=MAX_ITERATIONS)
    return plane is not None and float(inliers.mean()) >= MIN_SHARE


def exchange_words(image: np.ndarray, board: Board) -> str:
    """Return which two markers are exchanged on a board, if all others are in their places, as text; else "".

    Args:
        image: (height, width) 8-bit grey.
        board: the board of ``board.toml``.
    """
    ids, pixels = markers(image, board.dictionary)
    if len(ids) < MIN_MARKERS + 2:
        return ""
    corners = marker_corners(board, int(ids.max()) + 1)
    centres = corners.mean(axis=1)
    plane, _ = cv2.findHomography(
        corners[ids].reshape(-1, 2), pixels.reshape(-1, 2).astype(float), cv2.RANSAC, 8.0, maxIters=EXCHANGE_ITERATIONS
    )
    if plane is None:
        return ""
    predicted = cv2.perspectiveTransform(centres[:, None], plane)[:, 0]
    distances = np.linalg.norm(pixels.mean(axis=1)[:, None] - predicted, axis=2)
    nearest = distances.argmin(axis=1)
    places = dict(zip(ids.tolist(), nearest.tolist()))
    displaced = [marker for marker, place in places.items() if marker != place]
    if len(displaced) != 2 or places[displaced[0]] != displaced[1] or places[displaced[1]] != displaced[0]:
        return ""
    first, second = sorted(displaced)
    return f"markers {first} and {second} are exchanged on the board, the other {len(ids) - 2} fit: print it anew"


def marker_corners(board: Board, count: int) -> np.ndarray:
    """Return the corners (count, 4, 2) [m] of a board's first markers, from the upper left one clockwise.

    Args:
        board: a ChArUco board, or an AprilTag grid.
        count: number of markers; the board is continued downwards for them.
    """
    side = board.square
    pitch = side
    size = board.marker
    margin = 0.5 * (side - size)
    if board.kind == "apriltag":
        pitch = side + board.marker
        size = side
        margin = 0.0
    first_black = int(board.legacy and has_two_patterns(board))
    result = []
    row = 0
    while len(result) < count:
        for column in range(board.columns):
            is_black = board.kind == "charuco" and (row + column) % 2 == first_black
            if not is_black:
                x = column * pitch + margin
                y = row * pitch + margin
                result.append([[x, y], [x + size, y], [x + size, y + size], [x, y + size]])
        row += 1
    return np.array(result)[:count]
