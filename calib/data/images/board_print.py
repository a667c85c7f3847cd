"""Boards to print: SVG and PDF at true scale with a ruler, and their raster for a rendered camera."""

from contextlib import suppress
from itertools import product
from pathlib import Path

import cv2
import numpy as np

from calib import files
from calib.config import parse
from calib.data.images.board import KINDS, MIN_CORNERS, Board, corners, read_board, write_board
from calib.data.images.images import quiet
from calib.data.poses import BOARD
from calib.errors import CalibError, UsageError, require

PAPERS = {"a4": (0.210, 0.297), "a3": (0.297, 0.420), "a2": (0.420, 0.594), "a1": (0.594, 0.841), "a0": (0.841, 1.189)}
EDGE = 0.008  # printers leave this free [m]
RULER = 0.016  # height of the strip with the ruler and the words [m]
USUAL = {"charuco": ("5x5_100", 0.7, 9), "chessboard": ("5x5_100", 0.7, 10), "apriltag": ("apriltag_36h11", 0.3, 9)}
POINT = 0.0254 / 72.0  # PDF's unit [m]


def charuco(board: Board) -> cv2.aruco.CharucoBoard:
    """Return OpenCV's ChArUco board object (lengths in metres)."""
    size = board.columns, board.rows
    with quiet():
        return cv2.aruco.CharucoBoard(size, board.square, board.marker, dictionary(board.dictionary))


def dictionary(name: str) -> cv2.aruco.Dictionary:
    """Return OpenCV's marker dictionary by its name."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name.upper()}"))


def _black(board: Board) -> np.ndarray:
    """Return the black rectangles (N, 4) of a board: x, y, width, height [m] in its frame."""
    side = board.square
    pitch = side + board.marker
    margin = 0.5 * (side - board.marker)
    rectangles = []
    markers = []
    for row, column in product(range(board.rows), range(board.columns)):
        if board.kind == "apriltag":
            markers.append((column * pitch, row * pitch, side))
        elif (row + column) % 2 == 0:
            rectangles.append(np.array([[column * side, row * side, side, side]]))
        elif board.kind == "charuco":
            markers.append((column * side + margin, row * side + margin, board.marker))
    marker_dictionary = dictionary(board.dictionary)
    for number, (x, y, size) in enumerate(markers):
        bits = cv2.aruco.generateImageMarker(marker_dictionary, number, marker_dictionary.markerSize + 2, borderBits=1)
        rectangles.append(_rectangles(bits == 0, x, y, size / len(bits)))
    return np.concatenate(rectangles)


def _rectangles(dark: np.ndarray, x: float, y: float, side: float) -> np.ndarray:
    """Return rectangles (N, 4) [m] that cover the black fields of a marker, one per horizontal run."""
    result = []
    for row, line in enumerate(dark):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], line.astype(int), [0]])))
        for first, last in zip(edges[::2], edges[1::2]):
            result.append([x + first * side, y + row * side, (last - first) * side, side])
    return np.array(result).reshape(-1, 4)


def raster(board: Board, pixels_per_metre: float, margin: float) -> np.ndarray:
    """Return the image (H, W) of a board with a white margin [m]: reflectances, 0 black to 1 white.

    Every pixel's value is the white share of its area, so that edges are exact to sub-pixels.
    """
    width, height = (round((length + 2.0 * margin) * pixels_per_metre) for length in board.extent)
    image = np.ones((height, width), dtype=np.float32)

    def black_shares(first: float, length: float, count: int) -> tuple[slice, np.ndarray]:
        """Return the pixels that an interval [m] touches, and the share of each that it covers."""
        low = (first + margin) * pixels_per_metre
        high = (first + length + margin) * pixels_per_metre
        cells = np.arange(int(np.floor(low)), min(int(np.ceil(high)), count))
        covered = np.minimum(cells + 1, high) - np.maximum(cells, low)
        return slice(cells[0], cells[-1] + 1), np.clip(covered, 0.0, 1.0)

    for x, y, w, h in _black(board):
        rows, down = black_shares(y, h, height)
        columns, across = black_shares(x, w, width)
        image[rows, columns] -= np.outer(down, across).astype(np.float32)
    return np.clip(image, 0.0, 1.0)


def page_size(board: Board, paper: str = "") -> tuple[float, float]:
    """Return width and height [m] of the page that the board fits on: the stated paper, or the smallest one.

    Raises:
        UsageError: if the board does not fit on the page; the message states the largest square that fits.
    """
    needed = board.extent[0] + 2 * EDGE, board.extent[1] + 2 * EDGE + RULER
    papers = [PAPERS[paper]] if paper else list(PAPERS.values())
    largest_share = 0.0
    for short, long in papers:
        for width, height in ((short, long), (long, short)):
            share = min(width / needed[0], height / needed[1])
            if share >= 1.0:
                return width, height
            largest_share = max(largest_share, share)
    if not paper:
        return needed
    raise UsageError(
        f"the board takes {1e3 * needed[0]:.0f} x {1e3 * needed[1]:.0f} mm with margins and ruler, larger than "
        f"{paper.upper()}; squares of {int(1e3 * board.square * largest_share * 0.97)} mm would fit"
    )


def svg(board: Board, size: tuple[float, float]) -> str:
    """Return the page as SVG, in millimetres."""
    boxes, texts = _page(board, size)
    body = []
    for x, y, w, h in 1e3 * boxes:
        body.append(f'<rect x="{x:.4f}" y="{y:.4f}" width="{w:.4f}" height="{h:.4f}"/>')
    for x, y, text in texts:
        position = f'x="{1e3 * x:.2f}" y="{1e3 * y:.2f}"'
        body.append(f'<text {position} font-size="2.8" font-family="Helvetica, Arial">{text}</text>')
    width, height = (f"{1e3 * length:g}" for length in size)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}mm" height="{height}mm" viewBox="0 0 {width} {height}" '
        f'shape-rendering="crispEdges">\n<rect width="{width}" height="{height}" fill="white"/>\n'
        + "\n".join(body)
        + "\n</svg>\n"
    )


def pdf(board: Board, size: tuple[float, float]) -> bytes:
    """Return the page as a PDF at true scale, with print scaling switched off."""
    boxes, texts = _page(board, size)
    width, height = (length / POINT for length in size)
    lines = []
    for x, y, w, h in boxes:
        bottom = height - (y + h) / POINT
        lines.append(f"{x / POINT:.4f} {bottom:.4f} {w / POINT:.4f} {h / POINT:.4f} re")
    lines.append("f")
    for x, y, text in texts:
        escaped = text.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")
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
        result += f"{number} 0 obj\n".encode() + object_bytes + b"\nendobj\n"
    table = "".join(f"{offset:010d} 00000 n \n" for offset in offsets)
    tail = f"xref\n0 {len(objects) + 1}\n0000000000 65535 f \n{table}"
    tail += f"trailer\n<< /Size {len(objects) + 1} /Root 1 0 R >>\nstartxref\n{len(result)}\n%%EOF\n"
    return result + tail.encode()


def _page(board: Board, size: tuple[float, float]) -> tuple[np.ndarray, list[tuple[float, float, str]]]:
    """Return the black rectangles (N, 4) [m] and the texts of a page: board in the middle, ruler below."""
    left_edge = 0.5 * (size[0] - board.extent[0])
    top = 0.5 * (size[1] - RULER - board.extent[1])
    boxes = _black(board) + np.array([left_edge, top, 0.0, 0.0])
    length = 0.01 * int(100 * min(board.extent[0], 0.2) + 1e-9)
    base = size[1] - EDGE - 0.006
    line_width = 0.0002
    ticks = [[left_edge - line_width / 2, base, length + line_width, line_width]]
    for millimetre in range(round(1e3 * length) + 1):
        tick_height = 0.002
        if millimetre % 10 == 0:
            tick_height = 0.004
        elif millimetre % 5 == 0:
            tick_height = 0.003
        tick_edge = left_edge + 1e-3 * millimetre - line_width / 2
        ticks.append([tick_edge, base - tick_height, line_width, tick_height])
    advice = f"{board.words}, {board.dictionary}: print at 100 %, measure, put it into board.toml"
    texts = [
        (left_edge, base + 0.0035, "0"),
        (left_edge + length - 0.006, base + 0.0035, f"{1e3 * length:.0f} mm"),
        (left_edge + 0.008, base + 0.0035, advice),
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
    """Write ``board.toml``, ``board.pdf`` and ``board.svg``; return printing instructions.

    Args:
        out: folder.
        kind, columns, rows, words, paper: see `calib.data.images.board`; a dictionary, and the paper's name. None: the
            usual ones.
        square, marker: [mm].
        overwrite: replace another board that is there, whose squares somebody may have measured.

    Raises:
        UsageError: for a board that cannot be, or does not fit onto its paper, and for another that is there already.
    """
    require(kind in KINDS, f"--kind {kind}: expected one of {', '.join(KINDS)}", UsageError)
    if paper is not None and paper.lower() not in PAPERS:
        raise UsageError(f"--paper {paper}: expected one of {', '.join(PAPERS)}")
    min_square = 1.0  # side of a square [mm]
    if square < min_square:
        raise UsageError(f"--square {square:g}: a square of {square:g} mm cannot be printed; --square is in mm")
    default_dictionary, share, default_columns = USUAL[kind]
    marker_size = (share * square if marker is None else marker) / 1e3
    table = {
        "kind": kind,
        "columns": columns or default_columns,
        "rows": rows,
        "square": square / 1e3,
        "marker": marker_size,
    }
    board = parse(Board, table | {"dictionary": words or default_dictionary}, "impossible board")
    if (count := len(corners(board))) < MIN_CORNERS:
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
    width, height = (round(1e3 * length) for length in size)
    return [
        f"{board.words}, {len(corners(board))} corners, on a page of {width} x {height} mm: {out / 'board.pdf'}",
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
            with suppress(UsageError):  # a paper that it does not fit onto
                sizes.append(page_size(board, paper))
        return any(svg(board, size).encode() == drawn for size in dict.fromkeys(sizes))
    except (OSError, ValueError, CalibError):
        return False
