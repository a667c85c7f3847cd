"""Sub-pixel corner detection: a board's corners in an image with their σ, or the reason why it is unusable.

Markers are found in an image of some `max_pixels` pixels; corners are then refined in the full one by the orthogonality
of gradients (Förstner & Gülch 1987; OpenCV's cornerSubPix). A corner's standard deviation is the Cramér–Rao bound of
its patch, n² (Σ g gᵀ)⁻¹ with grey-level noise n and gradients g, and a floor.
"""

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from calib.data.images.board import DICTIONARIES, MIN_CORNERS, Board, corners
from calib.data.images.board_print import charuco, dictionary
from calib.data.images.images import quiet, read_image
from calib.data.images.pixels import Detection, Found
from calib.errors import MeasurementError

MIN_MARKERS = 4  # markers that tell a dictionary
FLOOR = {"charuco": 0.02, "chessboard": 0.02, "apriltag": 0.2}  # of a corner's sigma [px]; tags' wander with blur
BLURRED = 7.0  # width of an edge from which on an image is refused [px]
MOVED = 1.8  # ratio of the widths of edges across and along from which on blur is motion


def detect(image: np.ndarray, board: Board, thorough: bool = True) -> Detection:
    """Return the corners of a board detected in an image.

    Args:
        image: (height, width) 8-bit grey.
        board: what to look for.
        thorough: where nothing is found, look for other boards and mirrored ones, to say so.
    """
    table = corners(board)
    max_pixels = 1.5e6  # pixels of the image that markers are sought in (our choice)
    factor = min(1.0, np.sqrt(max_pixels / image.size))
    coarse = image if factor == 1.0 else cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    scale = np.array(image.shape[::-1]) / np.array(coarse.shape[::-1])
    ids, found = _coarse(coarse, board)
    if len(ids) < MIN_CORNERS and factor < 1.0:
        ids, found, scale = *_coarse(image, board), np.ones(2)
    found = (found + 0.5) * scale - 0.5
    none = Detection(np.full((len(table), 2), np.nan), np.full(len(table), np.nan))
    if len(ids) < min(MIN_CORNERS, len(table)):
        return replace(none, problem=_absent(image, coarse, board, len(ids), thorough))
    ids, found, spacing = _consistent(ids, found, table, board)
    ids, found = _refined(image, board, ids, found, spacing)
    if len(ids) < min(MIN_CORNERS, len(table)):
        return replace(none, problem=f"only {len(ids)} of {len(table)} corners are sharp enough: blurred, or too small")
    sigma, edge, motion = _quality(image, found, FLOOR[board.kind], spacing)
    pixel, sigmas = none.pixel.copy(), none.sigma.copy()
    pixel[ids], sigmas[ids] = found, sigma
    problem = ""
    if edge > BLURRED:
        cause = "the arm was still moving" if motion > MOVED else "out of focus, or the arm was still moving"
        problem = f"blurred, edges are {edge:.1f} px wide: {cause}"
    elif motion > MOVED and edge > 0.5 * BLURRED:
        problem = f"smeared in one direction ({motion:.1f} times): the arm was still moving"
    return Detection(pixel, sigmas, problem, edge)


def _coarse(image: np.ndarray, board: Board) -> tuple[np.ndarray, np.ndarray]:
    """Return corner numbers (n,) and pixels (n, 2) before refinement."""
    nothing = np.zeros(0, dtype=int), np.zeros((0, 2))
    if board.kind == "chessboard":
        inner = board.columns - 1, board.rows - 1
        done, found = cv2.findChessboardCornersSB(image, inner, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
        if not done:
            return nothing
        return np.arange(inner[0] * inner[1]), _upright(image, found.reshape(-1, 2), board)
    if board.kind == "charuco":
        with quiet():
            found, ids, _, _ = cv2.aruco.CharucoDetector(charuco(board)).detectBoard(image)
        return nothing if ids is None else (ids.ravel(), np.asarray(found).reshape(-1, 2))
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    found, ids, _ = cv2.aruco.ArucoDetector(dictionary(board.dictionary), parameters).detectMarkers(image)
    if ids is None:
        return nothing
    known = [(int(tag), place.reshape(4, 2)) for tag, place in zip(ids.ravel(), found) if tag < board.tags]
    if not known:
        return nothing
    return np.concatenate([4 * tag + np.arange(4) for tag, _ in known]), np.concatenate([each for _, each in known])


def _upright(image: np.ndarray, found: np.ndarray, board: Board) -> np.ndarray:
    """Return a chessboard's corners, reordered to begin at the upper left black square."""
    inner = found.reshape(board.rows - 1, board.columns - 1, 2)

    def level(a: np.ndarray, b: np.ndarray) -> float:
        x, y = np.clip(np.round(0.5 * (a + b)).astype(int), 0, np.array(image.shape[::-1]) - 1)
        return float(image[y, x])

    # the square inside the first four corners has the colour of the upper left one
    return found if level(inner[0, 0], inner[1, 1]) < level(inner[-1, -1], inner[-2, -2]) else found[::-1]


def _consistent(
    ids: np.ndarray, found: np.ndarray, table: np.ndarray, board: Board
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the corners consistent with a plane, and the side of a square [px]."""
    plane = cv2.findHomography(table[ids, :2], found, cv2.RANSAC, 8.0)[0]
    if plane is None:
        return ids[:0], found[:0], 1.0
    mapped = cv2.perspectiveTransform(table[ids, None, :2].astype(np.float64), plane)[:, 0]
    beside = cv2.perspectiveTransform((table[ids, None, :2] + [board.square, 0.0]).astype(np.float64), plane)[:, 0]
    below = cv2.perspectiveTransform((table[ids, None, :2] + [0.0, board.square]).astype(np.float64), plane)[:, 0]
    sides = np.stack([np.linalg.norm(each - mapped, axis=1) for each in (beside, below)])
    good = np.linalg.norm(mapped - found, axis=1) < 0.5 * sides.min(axis=0)
    return ids[good], found[good], float(np.percentile(sides.min(axis=0), 20))


def _refined(
    image: np.ndarray, board: Board, ids: np.ndarray, found: np.ndarray, spacing: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners refined to sub-pixels; corners at the image's edge or without convergence are dropped."""
    free = {"charuco": 0.5 * (1.0 - board.marker / board.square), "chessboard": 0.3, "apriltag": 0.09}[board.kind]
    half = int(np.clip(free * spacing, 2, 12))
    inside = ((found > half + 2) & (found < np.array(image.shape[::-1]) - half - 3)).all(axis=1)
    ids, found = ids[inside], found[inside]
    if not len(ids):
        return ids, found
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-3)
    start = found.astype(np.float32).reshape(-1, 1, 2)
    better = cv2.cornerSubPix(image, start.copy(), (half, half), (-1, -1), criteria).reshape(-1, 2)
    near = np.linalg.norm(better - found, axis=1) < max(2.0, 0.1 * spacing)
    return ids[near], better[near].astype(float)


def _quality(image: np.ndarray, found: np.ndarray, floor: float, spacing: float) -> tuple[np.ndarray, float, float]:
    """Return each corner's σ (n,) [px], the median edge width [px], and its ratio between the two directions."""
    max_half_width = 9  # half width of the patches that quality is measured in [px]
    half = int(np.clip(0.15 * spacing, 3, max_half_width))
    offsets = np.arange(-half, half + 1)
    middle = np.round(found).astype(int)
    rows = np.clip(middle[:, 1, None] + offsets, 0, image.shape[0] - 1)
    columns = np.clip(middle[:, 0, None] + offsets, 0, image.shape[1] - 1)
    patch = image[rows[:, :, None], columns[:, None, :]].astype(float)
    down, across = np.gradient(patch, axis=(1, 2))
    flat = patch.reshape(len(patch), -1)
    contrast = np.percentile(flat, 95, axis=1) - np.percentile(flat, 5, axis=1)
    second = patch[:, :, 2:] - 2 * patch[:, :, 1:-1] + patch[:, :, :-2]
    noise = max(float(np.percentile(np.abs(second), 30)) / (0.3853 * np.sqrt(6.0)), 0.3)  # 30 %: where nothing is
    tensor = np.stack([(across**2).sum((1, 2)), (across * down).sum((1, 2)), (down**2).sum((1, 2))], axis=1)
    determinant = np.maximum(tensor[:, 0] * tensor[:, 2] - tensor[:, 1] ** 2, 1e-9)
    bound = noise * np.sqrt(0.5 * (tensor[:, 0] + tensor[:, 2]) / determinant)
    widths = np.array([_widths(g, h, c) for g, h, c in zip(across, down, contrast)])
    return np.hypot(floor, bound), float(np.median(widths)), float(np.median(widths.max(1) / widths.min(1)))


def _widths(across: np.ndarray, down: np.ndarray, contrast: float) -> tuple[float, float]:
    """Return the widths [px] of the two edges crossing in a patch: contrast divided by each steepest gradient."""
    size = np.hypot(across, down)
    best = np.unravel_index(int(np.argmax(size)), size.shape)
    normal = np.array([across[best], down[best]]) / max(float(size[best]), 1e-9)
    aside = np.abs(across * normal[0] + down * normal[1]) < 0.7 * size
    other = float(np.percentile(size[aside], 98)) if aside.any() else float(size[best])
    own = float(np.percentile(size[~aside], 98))
    return contrast / max(own, 1e-3), contrast / max(other, 1e-3)


def _absent(image: np.ndarray, coarse: np.ndarray, board: Board, count: int, thorough: bool) -> str:
    """Return the likely reason why no board was detected."""
    if count:
        return f"only {count} corners of the board are in view, {MIN_CORNERS} are needed: move it into view"
    if np.percentile(image[::5, ::5], 99) < 30:
        return "too dark: hardly anything is brighter than 30 of 255; expose longer"
    if np.mean(image[::5, ::5] > 252) > 0.25:
        return "over-exposed: a quarter of the image is white or more; expose shorter"
    if thorough:
        if len(_coarse(np.ascontiguousarray(coarse[:, ::-1]), board)[0]) >= MIN_CORNERS:
            return "the board is seen mirrored: is the image flipped, or seen in a mirror? Save it unflipped"
        if board.kind != "chessboard":
            if (seen := _markers(coarse, board.dictionary)) >= MIN_MARKERS:
                return (
                    f"{seen} markers of {board.dictionary} are seen, but not where board.toml has them: are kind, "
                    "columns and rows (squares, not inner corners) those of the print?"
                )
            if other := _other_dictionary(coarse, board):
                return f"no markers of {board.dictionary}, but some of {other}: state it in board.toml"
    width = _sharpest(coarse)
    if width > 3.5:
        return f"no board found; the image's sharpest edges are {width:.0f} px wide: out of focus, or still moving"
    return "no board found: out of view, hidden, blurred or in glare"


def _other_dictionary(image: np.ndarray, board: Board) -> str:
    """Return the name of the dictionary with the most detected markers; "" if hardly any are detected."""
    own = board.dictionary.split("_")[0]
    others = [each for each in DICTIONARIES if each.endswith("_100") or each.startswith("apriltag_36h11")]
    counts = {each: _markers(image, each) for each in others if each.split("_")[0] != own}
    best = max(counts, key=lambda each: counts[each])
    return best if counts[best] >= MIN_MARKERS else ""


def _markers(image: np.ndarray, name: str) -> int:
    """Return the number of detected markers of a dictionary in an image."""
    ids = cv2.aruco.ArucoDetector(dictionary(name)).detectMarkers(image)[1]
    return 0 if ids is None else len(ids)


def _sharpest(image: np.ndarray) -> float:
    """Return the width of the sharpest edges of an image [px]: its contrast over its steepest gradients."""
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 0.8)
    across, down = cv2.Sobel(smooth, cv2.CV_32F, 1, 0) / 8.0, cv2.Sobel(smooth, cv2.CV_32F, 0, 1) / 8.0
    low, high = np.percentile(smooth, [1, 99.5])
    return float((high - low) / max(float(np.percentile(np.hypot(across, down), 99.9)), 1e-3))


def detected(
    images: Iterable[tuple[str, Path | np.ndarray]],
    board: Board,
    count: int = 0,
    progress: Callable[[int, int, str], None] | None = None,
) -> Found:
    """Detect a board in images (files or arrays) and return the corners by image name.

    Images of another size than most are of no use: a camera's lens is that of one size.
    """
    result, sizes, useless = dict[str, Detection](), dict[str, tuple[int, int]](), 0
    blank = np.full((len(corners(board)), 2), np.nan)
    max_examined = 3  # useless images that are looked into for the reason, unless it is found
    for number, (name, each) in enumerate(images):
        if progress:
            progress(number, count, name)
        try:
            image = read_image(each) if isinstance(each, Path) else each
        except MeasurementError as error:
            result[name] = Detection(blank, blank[:, 0], str(error).removeprefix(f"{each}: "))
            continue
        sizes[name] = image.shape[1], image.shape[0]
        result[name] = detect(image, board, thorough=useless < max_examined)
        useless += result[name].problem.startswith("no board found")
    if not sizes:
        return Found(result)
    usual = Counter(sizes.values()).most_common(1)[0][0]
    for name, size in sizes.items():
        if size != usual:
            turned = "; did a program rotate it?" if size == usual[::-1] else ""
            words = f"{size[0]} x {size[1]} pixels, where most are {usual[0]} x {usual[1]}{turned}"
            result[name] = Detection(blank, blank[:, 0], words)
    return Found(result, usual)
