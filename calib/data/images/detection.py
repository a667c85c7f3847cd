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
    ids, pixels = _coarse(coarse, board)
    if len(ids) < MIN_CORNERS and factor < 1.0:
        ids, pixels, scale = *_coarse(image, board), np.ones(2)
    pixels = (pixels + 0.5) * scale - 0.5
    no_detection = Detection(np.full((len(table), 2), np.nan), np.full(len(table), np.nan))
    if len(ids) < min(MIN_CORNERS, len(table)):
        return replace(no_detection, problem=_absent(image, coarse, board, len(ids), thorough))
    ids, pixels, spacing = _consistent(ids, pixels, table, board)
    ids, pixels = _refined(image, board, ids, pixels, spacing)
    if len(ids) < min(MIN_CORNERS, len(table)):
        return replace(
            no_detection, problem=f"only {len(ids)} of {len(table)} corners are sharp enough: blurred, or too small"
        )
    sigma, edge, motion = _quality(image, pixels, FLOOR[board.kind], spacing)
    pixel, sigmas = no_detection.pixel.copy(), no_detection.sigma.copy()
    pixel[ids], sigmas[ids] = pixels, sigma
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
        success, pixels = cv2.findChessboardCornersSB(image, inner, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
        if not success:
            return nothing
        return np.arange(inner[0] * inner[1]), _upright(image, pixels.reshape(-1, 2), board)
    if board.kind == "charuco":
        with quiet():
            pixels, ids, _, _ = cv2.aruco.CharucoDetector(charuco(board)).detectBoard(image)
        return nothing if ids is None else (ids.ravel(), np.asarray(pixels).reshape(-1, 2))
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    pixels, ids, _ = cv2.aruco.ArucoDetector(dictionary(board.dictionary), parameters).detectMarkers(image)
    if ids is None:
        return nothing
    tags = [
        (int(tag), corners_of_tag.reshape(4, 2)) for tag, corners_of_tag in zip(ids.ravel(), pixels) if tag < board.tags
    ]
    if not tags:
        return nothing
    return np.concatenate([4 * tag + np.arange(4) for tag, _ in tags]), np.concatenate(
        [corners_of_tag for _, corners_of_tag in tags]
    )


def _upright(image: np.ndarray, pixels: np.ndarray, board: Board) -> np.ndarray:
    """Return a chessboard's corners, reordered to begin at the upper left black square."""
    inner = pixels.reshape(board.rows - 1, board.columns - 1, 2)

    def level(a: np.ndarray, b: np.ndarray) -> float:
        x, y = np.clip(np.round(0.5 * (a + b)).astype(int), 0, np.array(image.shape[::-1]) - 1)
        return float(image[y, x])

    # the square inside the first four corners has the colour of the upper left one
    return pixels if level(inner[0, 0], inner[1, 1]) < level(inner[-1, -1], inner[-2, -2]) else pixels[::-1]


def _consistent(
    ids: np.ndarray, pixels: np.ndarray, table: np.ndarray, board: Board
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the corners consistent with a plane, and the side of a square [px]."""
    plane = cv2.findHomography(table[ids, :2], pixels, cv2.RANSAC, 8.0)[0]
    if plane is None:
        return ids[:0], pixels[:0], 1.0
    mapped = cv2.perspectiveTransform(table[ids, None, :2].astype(np.float64), plane)[:, 0]
    right = cv2.perspectiveTransform((table[ids, None, :2] + [board.square, 0.0]).astype(np.float64), plane)[:, 0]
    below = cv2.perspectiveTransform((table[ids, None, :2] + [0.0, board.square]).astype(np.float64), plane)[:, 0]
    sides = np.stack([np.linalg.norm(neighbours - mapped, axis=1) for neighbours in (right, below)])
    consistent = np.linalg.norm(mapped - pixels, axis=1) < 0.5 * sides.min(axis=0)
    return ids[consistent], pixels[consistent], float(np.percentile(sides.min(axis=0), 20))


def _refined(
    image: np.ndarray, board: Board, ids: np.ndarray, pixels: np.ndarray, spacing: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners refined to sub-pixels; corners at the image's edge or without convergence are dropped."""
    free = {"charuco": 0.5 * (1.0 - board.marker / board.square), "chessboard": 0.3, "apriltag": 0.09}[board.kind]
    half = int(np.clip(free * spacing, 2, 12))
    interior = ((pixels > half + 2) & (pixels < np.array(image.shape[::-1]) - half - 3)).all(axis=1)
    ids, pixels = ids[interior], pixels[interior]
    if not len(ids):
        return ids, pixels
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-3)
    start = pixels.astype(np.float32).reshape(-1, 1, 2)
    better = cv2.cornerSubPix(image, start.copy(), (half, half), (-1, -1), criteria).reshape(-1, 2)
    converged = np.linalg.norm(better - pixels, axis=1) < max(2.0, 0.1 * spacing)
    return ids[converged], better[converged].astype(float)


def _quality(image: np.ndarray, pixels: np.ndarray, floor: float, spacing: float) -> tuple[np.ndarray, float, float]:
    """Return each corner's σ (n,) [px], the median edge width [px], and its ratio between the two directions."""
    max_half_width = 9  # half width of the patches that quality is measured in [px]
    half = int(np.clip(0.15 * spacing, 3, max_half_width))
    offsets = np.arange(-half, half + 1)
    middle = np.round(pixels).astype(int)
    rows = np.clip(middle[:, 1, None] + offsets, 0, image.shape[0] - 1)
    columns = np.clip(middle[:, 0, None] + offsets, 0, image.shape[1] - 1)
    patch = image[rows[:, :, None], columns[:, None, :]].astype(float)
    vertical, horizontal = np.gradient(patch, axis=(1, 2))
    flat = patch.reshape(len(patch), -1)
    contrast = np.percentile(flat, 95, axis=1) - np.percentile(flat, 5, axis=1)
    second = patch[:, :, 2:] - 2 * patch[:, :, 1:-1] + patch[:, :, :-2]
    noise = max(float(np.percentile(np.abs(second), 30)) / (0.3853 * np.sqrt(6.0)), 0.3)  # 30 %: where nothing is
    tensor = np.stack(
        [(horizontal**2).sum((1, 2)), (horizontal * vertical).sum((1, 2)), (vertical**2).sum((1, 2))], axis=1
    )
    determinant = np.maximum(tensor[:, 0] * tensor[:, 2] - tensor[:, 1] ** 2, 1e-9)
    bound = noise * np.sqrt(0.5 * (tensor[:, 0] + tensor[:, 2]) / determinant)
    widths = np.array([_widths(g, h, c) for g, h, c in zip(horizontal, vertical, contrast)])
    return np.hypot(floor, bound), float(np.median(widths)), float(np.median(widths.max(1) / widths.min(1)))


def _widths(horizontal: np.ndarray, vertical: np.ndarray, contrast: float) -> tuple[float, float]:
    """Return the widths [px] of the two edges crossing in a patch: contrast divided by each steepest gradient."""
    size = np.hypot(horizontal, vertical)
    best = np.unravel_index(int(np.argmax(size)), size.shape)
    normal = np.array([horizontal[best], vertical[best]]) / max(float(size[best]), 1e-9)
    is_across = np.abs(horizontal * normal[0] + vertical * normal[1]) < 0.7 * size
    cross_gradient = float(np.percentile(size[is_across], 98)) if is_across.any() else float(size[best])
    main_gradient = float(np.percentile(size[~is_across], 98))
    return contrast / max(main_gradient, 1e-3), contrast / max(cross_gradient, 1e-3)


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
            marker_count = _markers(coarse, board.dictionary)
            if marker_count >= MIN_MARKERS:
                return (
                    f"{marker_count} markers of {board.dictionary} are seen, but not where board.toml has them: are "
                    "kind, columns and rows (squares, not inner corners) those of the print?"
                )
            if other_name := _other_dictionary(coarse, board):
                return f"no markers of {board.dictionary}, but some of {other_name}: state it in board.toml"
    width = _sharpest(coarse)
    if width > 3.5:
        return f"no board found; the image's sharpest edges are {width:.0f} px wide: out of focus, or still moving"
    return "no board found: out of view, hidden, blurred or in glare"


def _other_dictionary(image: np.ndarray, board: Board) -> str:
    """Return the name of the dictionary with the most detected markers; "" if hardly any are detected."""
    family = board.dictionary.split("_")[0]
    candidates = [name for name in DICTIONARIES if name.endswith("_100") or name.startswith("apriltag_36h11")]
    counts = {name: _markers(image, name) for name in candidates if name.split("_")[0] != family}
    best = max(counts, key=lambda name: counts[name])
    return best if counts[best] >= MIN_MARKERS else ""


def _markers(image: np.ndarray, name: str) -> int:
    """Return the number of detected markers of a dictionary in an image."""
    ids = cv2.aruco.ArucoDetector(dictionary(name)).detectMarkers(image)[1]
    return 0 if ids is None else len(ids)


def _sharpest(image: np.ndarray) -> float:
    """Return the width of the sharpest edges of an image [px]: its contrast over its steepest gradients."""
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 0.8)
    horizontal, vertical = cv2.Sobel(smooth, cv2.CV_32F, 1, 0) / 8.0, cv2.Sobel(smooth, cv2.CV_32F, 0, 1) / 8.0
    low, high = np.percentile(smooth, [1, 99.5])
    return float((high - low) / max(float(np.percentile(np.hypot(horizontal, vertical), 99.9)), 1e-3))


def detected(
    images: Iterable[tuple[str, Path | np.ndarray]],
    board: Board,
    count: int = 0,
    progress: Callable[[int, int, str], None] | None = None,
) -> Found:
    """Detect a board in images (files or arrays) and return the corners by image name.

    Images of another size than most are of no use: a camera's lens is that of one size.
    """
    result, sizes, failures = dict[str, Detection](), dict[str, tuple[int, int]](), 0
    blank = np.full((len(corners(board)), 2), np.nan)
    max_examined = 3  # useless images that are looked into for the reason, unless it is found
    for number, (name, source) in enumerate(images):
        if progress:
            progress(number, count, name)
        try:
            image = read_image(source) if isinstance(source, Path) else source
        except MeasurementError as error:
            result[name] = Detection(blank, blank[:, 0], str(error).removeprefix(f"{source}: "))
            continue
        sizes[name] = image.shape[1], image.shape[0]
        result[name] = detect(image, board, thorough=failures < max_examined)
        failures += result[name].problem.startswith("no board found")
    if not sizes:
        return Found(result)
    usual_size = Counter(sizes.values()).most_common(1)[0][0]
    for name, size in sizes.items():
        if size != usual_size:
            hint = "; did a program rotate it?" if size == usual_size[::-1] else ""
            problem = f"{size[0]} x {size[1]} pixels, where most are {usual_size[0]} x {usual_size[1]}{hint}"
            result[name] = Detection(blank, blank[:, 0], problem)
    return Found(result, usual_size)
