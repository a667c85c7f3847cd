"""Boards to print: SVG and PDF at true scale with a ruler, and their raster for a rendered camera."""

from contextlib import suppress
from itertools import product
from pathlib import Path

import numpy as np

from calib import files
from calib.config import parse
from calib.data.images.board import KINDS, MIN_CORNERS, Board, corners, read_board, write_board
from calib.data.images.images import quiet
from calib.data.poses import BOARD
from calib.errors import CalibError, UsageError, require
from calib.workers.extras import needing

with needing("cv2"):
    import cv2

# Formats of paper: short and long side [m].
PAPERS = {"a4": (0.210, 0.297), "a3": (0.297, 0.420), "a2": (0.420, 0.594), "a1": (0.594, 0.841), "a0": (0.841, 1.189)}
# Width of the page's edge on which printers do not print [m].
EDGE = 0.008
# Height of the strip with the ruler and the text [m].
RULER = 0.016
# Defaults by kind of board: dictionary, marker (or gap) as a share of the square, number of columns.
USUAL = {"charuco": ("5x5_100", 0.7, 9), "chessboard": ("5x5_100", 0.7, 10), "apriltag": ("apriltag_36h11", 0.3, 9)}
# Unit of length of a PDF [m].
POINT = 0.0254 / 72.0
# Longest ruler [m], its distance from the lower edge's margin [m], width of its lines [m].
MAX_RULER = 0.2
RULER_OFFSET = 0.006
LINE_WIDTH = 0.0002
# Heights of the ruler's ticks [m] at each centimetre, half centimetre and millimetre.
CENTIMETRE_TICK = 0.004
HALF_TICK = 0.003
MILLIMETRE_TICK = 0.002
# Distance of the text below the ruler [m].
TEXT_OFFSET = 0.0035
# Smallest side of a square [mm].
MIN_SQUARE_MM = 1.0
# Share of the largest square that fits onto a page which a message recommends.
RECOMMENDED_SHARE = 0.97


def charuco(board: Board) -> cv2.aruco.CharucoBoard:
    """Return a board as OpenCV's ChArUco board object, with lengths in metres."""
    size = board.columns, board.rows
    with quiet():
        result = cv2.aruco.CharucoBoard(size, board.square, board.marker, dictionary(board.dictionary))
        result.setLegacyPattern(board.legacy)
        return result


def dictionary(name: str) -> cv2.aruco.Dictionary:
    """Return OpenCV's marker dictionary by its name, as in ``board.toml``."""
    number = getattr(cv2.aruco, f"DICT_{name.upper()}")
    return cv2.aruco.getPredefinedDictionary(number)


def _black(board: Board) -> np.ndarray:
    """Return the black rectangles (N, 4) of a board: x, y, width, height [m] in its frame."""
    side = board.square
    pitch = side + board.marker
    margin = 0.5 * (side - board.marker)
    rectangles = []
    markers = []
    first_black = int(board.legacy and board.kind == "charuco" and board.rows % 2 == 0)
    for row, column in product(range(board.rows), range(board.columns)):
        x = column * side
        y = row * side
        if board.kind == "apriltag":
            markers.append((column * pitch, row * pitch, side))
        elif (row + column) % 2 == first_black:
            rectangles.append(np.array([[x, y, side, side]]))
        elif board.kind == "charuco":
            markers.append((x + margin, y + margin, board.marker))
    marker_dictionary = dictionary(board.dictionary)
    fields = marker_dictionary.markerSize + 2
    for number, (x, y, size) in enumerate(markers):
        bits = cv2.aruco.generateImageMarker(marker_dictionary, number, fields, borderBits=1)
        is_black = bits == 0
        rectangles.append(_rectangles(is_black, x, y, size / len(bits)))
    return np.concatenate(rectangles)


def _rectangles(dark: np.ndarray, x: float, y: float, side: float) -> np.ndarray:
    """Return rectangles (N, 4) [m] that cover the black fields of a marker: x, y, width, height per horizontal run.

    Args:
        dark: (n, n) whether each field of the marker is black.
        x, y: upper left corner of the marker [m].
        side: side of a field [m].
    """
    result = []
    for row, line in enumerate(dark):
        bordered = np.concatenate([[0], line.astype(int), [0]])
        edges = np.flatnonzero(np.diff(bordered))
        top = y + row * side
        for first, last in zip(edges[::2], edges[1::2]):
            left = x + first * side
            width = (last - first) * side
            result.append([left, top, width, side])
    return np.array(result).reshape(-1, 4)


def raster(board: Board, pixels_per_metre: float, margin: float) -> np.ndarray:
    """Return the image (H, W) of a printed board as reflectances from 0 (black) to 1 (white).

    The value of a pixel is the white share of its area, so that edges are exact to sub-pixels.

    Args:
        board: the board.
        pixels_per_metre: resolution of the image.
        margin: width of the white margin around the pattern [m].
    """
    extent = np.array(board.extent) + 2.0 * margin
    width = round(float(extent[0]) * pixels_per_metre)
    height = round(float(extent[1]) * pixels_per_metre)
    image = np.ones((height, width), dtype=np.float32)

    def black_shares(first: float, length: float, count: int) -> tuple[slice, np.ndarray]:
        """Return the pixels that an interval [m] touches, and the share of each that it covers."""
        low = (first + margin) * pixels_per_metre
        high = (first + length + margin) * pixels_per_metre
        first_cell = int(np.floor(low))
        end_cell = min(int(np.ceil(high)), count)
        cells = np.arange(first_cell, end_cell)
        covered = np.minimum(cells + 1, high) - np.maximum(cells, low)
        touched = slice(cells[0], cells[-1] + 1)
        return touched, np.clip(covered, 0.0, 1.0)

    for x, y, w, h in _black(board):
        rows, down = black_shares(y, h, height)
        columns, across = black_shares(x, w, width)
        shares = np.outer(down, across)
        image[rows, columns] -= shares.astype(np.float32)
    return np.clip(image, 0.0, 1.0)


def page_size(board: Board, paper: str = "") -> tuple[float, float]:
    """Return width and height [m] of the page on which the board is printed, upright or across.

    Args:
        board: the board.
        paper: name of the paper in `PAPERS`; "": the smallest one that the board fits onto, else a page of the board's
            size with its margins.

    Raises:
        UsageError: if the board does not fit on the page; the message states the largest square that fits.
    """
    board_width, board_height = board.extent
    needed_width = board_width + 2 * EDGE
    needed_height = board_height + 2 * EDGE + RULER
    papers = list(PAPERS.values())
    if paper:
        papers = [PAPERS[paper]]
    largest_share = 0.0
    for short, long in papers:
        for width, height in ((short, long), (long, short)):
            share = min(width / needed_width, height / needed_height)
            if share >= 1.0:
                return width, height
            largest_share = max(largest_share, share)
    if not paper:
        return needed_width, needed_height
    fitting_mm = int(1e3 * board.square * largest_share * RECOMMENDED_SHARE)
    raise UsageError(
        f"the board takes {1e3 * needed_width:.0f} x {1e3 * needed_height:.0f} mm with margins and ruler, larger than "
        f"{paper.upper()}; squares of {fitting_mm} mm would fit"
    )


def svg(board: Board, size: tuple[float, float]) -> str:
    """Return the page as SVG in millimetres; `size`: width and height of the page [m]."""
    boxes, texts = _page(board, size)
    body = []
    for x, y, w, h in 1e3 * boxes:
        body.append(f'<rect x="{x:.4f}" y="{y:.4f}" width="{w:.4f}" height="{h:.4f}"/>')
    for x, y, text in texts:
        position = f'x="{1e3 * x:.2f}" y="{1e3 * y:.2f}"'
        body.append(f'<text {position} font-size="2.8" font-family="Helvetica, Arial">{text}</text>')
    width = f"{1e3 * size[0]:g}"
    height = f"{1e3 * size[1]:g}"
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}mm" height="{height}mm" viewBox="0 0 {width} {height}" '
        f'shape-rendering="crispEdges">\n<rect width="{width}" height="{height}" fill="white"/>\n'
        + "\n".join(body)
        + "\n</svg>\n"
    )


def pdf(board: Board, size: tuple[float, float]) -> bytes:
    """Return the page as a PDF at true scale, with print scaling switched off; `size`: width and height [m]."""
    boxes, texts = _page(board, size)
    width = size[0] / POINT
    height = size[1] / POINT
    lines = []
    for x, y, w, h in boxes:
        bottom = height - (y + h) / POINT
        lines.append(f"{x / POINT:.4f} {bottom:.4f} {w / POINT:.4f} {h / POINT:.4f} re")
    lines.append("f")
    for x, y, text in texts:
        escaped = text.replace("\\", r"\\")
        escaped = escaped.replace("(", r"\(")
        escaped = escaped.replace(")", r"\)")
        lines.append(f"BT /F1 8 Tf {x / POINT:.3f} {height - y / POINT:.3f} Td ({escaped}) Tj ET")
    content = "\n".join(lines).encode("latin-1", "replace")
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {width:.4f} {height:.4f}] /Contents 4 0 R "
        "/Resources << /Font << /F1 5 0 R >> >> >>".encode(),
        f"<< /Length {len(content)} >>\nstream\n".encode() + content + b"\nendstream",
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>",
    ]
    result = b"%PDF-1.4\n"
    offsets = []
    for number, object_bytes in enumerate(objects, 1):
        offsets.append(len(result))
        beginning = f"{number} 0 obj\n".encode()
        result += beginning + object_bytes + b"\nendobj\n"
    table = "".join(f"{offset:010d} 00000 n \n" for offset in offsets)
    tail = f"xref\n0 {len(objects) + 1}\n0000000000 65535 f \n{table}"
    tail += f"trailer\n<< /Size {len(objects) + 1} /Root 1 0 R >>\nstartxref\n{len(result)}\n%%EOF\n"
    return result + tail.encode()


def _page(board: Board, size: tuple[float, float]) -> tuple[np.ndarray, list[tuple[float, float, str]]]:
    """Return the black rectangles (N, 4) [m] and the texts of a page: board in the middle, ruler below."""
    page_width, page_height = size
    board_width, board_height = board.extent
    left_edge = 0.5 * (page_width - board_width)
    top = 0.5 * (page_height - RULER - board_height)
    offset = np.array([left_edge, top, 0.0, 0.0])
    boxes = _black(board) + offset

    # ruler of whole centimetres
    centimetres = int(100 * min(board_width, MAX_RULER) + 1e-9)
    length = 0.01 * centimetres
    base = page_height - EDGE - RULER_OFFSET
    ruler_edge = left_edge - LINE_WIDTH / 2
    ticks = [[ruler_edge, base, length + LINE_WIDTH, LINE_WIDTH]]
    for millimetre in range(round(1e3 * length) + 1):
        tick_height = MILLIMETRE_TICK
        if millimetre % 10 == 0:
            tick_height = CENTIMETRE_TICK
        elif millimetre % 5 == 0:
            tick_height = HALF_TICK
        tick_edge = left_edge + 1e-3 * millimetre - LINE_WIDTH / 2
        ticks.append([tick_edge, base - tick_height, LINE_WIDTH, tick_height])

    text_base = base + TEXT_OFFSET
    advice = f"{board.words}, {board.dictionary}: print at 100 %, measure, put it into board.toml"
    texts = [
        (left_edge, text_base, "0"),
        (left_edge + length - 0.006, text_base, f"{1e3 * length:.0f} mm"),
        (left_edge + 0.008, text_base, advice),
    ]
    return np.concatenate([boxes, ticks]), texts


def make(
    out: Path,
    kind: str,
    columns: int | None,
    rows: int,
    square: float,
    marker: float | None,
    words: str | None,
    paper: str | None,
    overwrite: bool = False,
) -> list[str]:
    """Write ``board.toml``, ``board.pdf`` and ``board.svg`` into a folder; return printing instructions.

    Args:
        out: the folder.
        kind, columns, rows: see `calib.data.images.board`; columns None: the default of the kind.
        square: side of a square (or tag) [mm].
        marker: side of a marker (AprilTag grid: gap between tags) [mm]; None: the default share of the square.
        words: dictionary of the markers; None: the default of the kind.
        paper: name of the paper in `PAPERS`; None: the smallest paper that the board fits onto.
        overwrite: whether to replace another board in the folder, whose file may state measured squares.

    Raises:
        UsageError: for an impossible board, a board that does not fit onto the paper, or, without `overwrite`, a folder
            with another board.
    """
    require(kind in KINDS, f"--kind {kind}: expected one of {', '.join(KINDS)}", UsageError)
    if paper is not None and paper.lower() not in PAPERS:
        raise UsageError(f"--paper {paper}: expected one of {', '.join(PAPERS)}")
    if square < MIN_SQUARE_MM:
        raise UsageError(f"--square {square:g}: a square of {square:g} mm cannot be printed; --square is in mm")
    default_dictionary, share, default_columns = USUAL[kind]
    marker_mm = marker
    if marker_mm is None:
        marker_mm = share * square
    table = {
        "kind": kind,
        "columns": columns or default_columns,
        "rows": rows,
        "square": square / 1e3,
        "marker": marker_mm / 1e3,
        "dictionary": words or default_dictionary,
    }
    board = parse(Board, table, "impossible board")
    count = len(corners(board))
    if count < MIN_CORNERS:
        raise UsageError(f"a {board.words} has {count} corners, an image needs {MIN_CORNERS}: take more squares")
    size = page_size(board, (paper or "").lower())
    board_file = out / BOARD
    if not overwrite and board_file.exists() and not _as_printed(out):
        raise UsageError(
            f"{board_file} was changed after printing (measured squares?) or describes another board; nothing was "
            "written. Take another folder (--out), or give --overwrite"
        )
    files.write(out / "board.pdf", pdf(board, size))
    files.write(out / "board.svg", svg(board, size))
    write_board(board, out / BOARD)
    width_mm = round(1e3 * size[0])
    height_mm = round(1e3 * size[1])
    return [
        f"{board.words}, {count} corners, on a page of {width_mm} x {height_mm} mm: {out / 'board.pdf'}",
        "print it at 100 % (not fitted to the page), check the ruler, glue it onto glass or aluminium; then measure "
        f"several squares together and put the size of one into {out / BOARD}: the robot's lengths get their "
        "scale from it",
    ]


def _as_printed(out: Path) -> bool:
    """Return whether a folder's ``board.toml`` is unchanged since `make` wrote it with ``board.svg``."""
    try:
        board = read_board(out)
        drawn = (out / "board.svg").read_bytes()
        sizes = []
        for paper in ("", *PAPERS):
            # raised for a paper that the board does not fit onto
            with suppress(UsageError):
                sizes.append(page_size(board, paper))
        pages = [svg(board, size).encode() for size in dict.fromkeys(sizes)]
        return drawn in pages
    except (OSError, ValueError, CalibError):
        return False
