"""Sub-pixel corner detection: a board's corners in an image with their σ, or the reason why it is unusable.

Markers are found in an image of some `max_pixels` pixels; corners are then refined in the full one by the orthogonality
of gradients (Förstner & Gülch 1987; OpenCV's cornerSubPix). A corner's standard deviation is the Cramér–Rao bound of
its patch, n² (Σ g gᵀ)⁻¹ with grey-level noise n and gradients g, with a lower bound.
"""

from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path

import cv2
import numpy as np

from calib.data.images.board import DICTIONARIES, MIN_CORNERS, Board, corners
from calib.data.images.board_print import charuco, dictionary
from calib.data.images.images import quiet, read_image
from calib.data.images.pixels import Detection, Found
from calib.errors import MeasurementError

# markers that tell a dictionary
MIN_MARKERS = 4
# of a corner's sigma [px]; tags' wander with blur
FLOOR = {"charuco": 0.02, "chessboard": 0.02, "apriltag": 0.2}
# width of an edge from which on an image is refused [px]
BLURRED = 7.0
# ratio of the widths of edges across and along from which on blur is motion
MOTION_RATIO = 1.8
# pixels of the image that markers are sought in (our choice)
MAX_PIXELS = 1.5e6
# half width of the patches that quality is measured in [px]
MAX_HALF_WIDTH = 9
# useless images that are looked into for the reason, unless it is found
MAX_EXAMINED = 3
# of a corner's refinement
CRITERIA = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-3)


def detect(image: np.ndarray, board: Board, thorough: bool = True) -> Detection:
    """Return the corners of a board detected in an image.

    Args:
        image: (height, width) 8-bit grey.
        board: the board to look for.
        thorough: whether, if the board is not found, to look for other and mirrored boards, which `problem` then names.
    """
    table = corners(board)
    min_corners = min(MIN_CORNERS, len(table))
    coarse = image
    factor = min(1.0, np.sqrt(MAX_PIXELS / image.size))
    if factor < 1.0:
        coarse = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    scale = np.array(image.shape[::-1]) / np.array(coarse.shape[::-1])
    ids, pixels = _coarse(coarse, board)
    if len(ids) < MIN_CORNERS and factor < 1.0:
        ids, pixels = _coarse(image, board)
        scale = np.ones(2)
    pixels = (pixels + 0.5) * scale - 0.5
    no_pixels = np.full((len(table), 2), np.nan)
    no_sigmas = np.full(len(table), np.nan)
    if len(ids) < min_corners:
        reason = _absent(image, coarse, board, len(ids), thorough)
        return Detection(no_pixels, no_sigmas, problem=reason)

    ids, pixels, spacing = _consistent(ids, pixels, table, board)
    ids, pixels = _refined(image, board, ids, pixels, spacing)
    if len(ids) < min_corners:
        reason = f"only {len(ids)} of {len(table)} corners are sharp enough: blurred, or too small"
        return Detection(no_pixels, no_sigmas, problem=reason)
    sigma, edge, motion = _quality(image, pixels, FLOOR[board.kind], spacing)
    pixel, sigmas = no_pixels, no_sigmas
    pixel[ids] = pixels
    sigmas[ids] = sigma
    problem = ""
    if edge > BLURRED:
        cause = "out of focus, or the arm was still moving"
        if motion > MOTION_RATIO:
            cause = "the arm was still moving"
        problem = f"blurred, edges are {edge:.1f} px wide: {cause}"
    elif motion > MOTION_RATIO and edge > 0.5 * BLURRED:
        problem = f"smeared in one direction ({motion:.1f} times): the arm was still moving"
    return Detection(pixel, sigmas, problem, edge)


def _coarse(image: np.ndarray, board: Board) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers (n,) and pixels (n, 2) of the detected corners, before refinement."""
    nothing = np.zeros(0, dtype=int), np.zeros((0, 2))
    if board.kind == "chessboard":
        columns, rows = board.columns - 1, board.rows - 1
        success, pixels = cv2.findChessboardCornersSB(image, (columns, rows), flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
        if not success:
            return nothing
        return np.arange(columns * rows), _upright(image, pixels.reshape(-1, 2), board)
    if board.kind == "charuco":
        with quiet():
            pixels, ids, _, _ = cv2.aruco.CharucoDetector(charuco(board)).detectBoard(image)
        if ids is None:
            return nothing
        return ids.ravel(), np.asarray(pixels).reshape(-1, 2)

    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(dictionary(board.dictionary), parameters)
    tag_pixels, tags, _ = detector.detectMarkers(image)
    if tags is None:
        return nothing
    ids, pixels = [], []
    for tag, corners_of_tag in zip(tags.ravel().tolist(), tag_pixels):
        if tag < board.tags:
            ids.append(4 * tag + np.arange(4))
            pixels.append(corners_of_tag.reshape(4, 2))
    if not ids:
        return nothing
    return np.concatenate(ids), np.concatenate(pixels)


def _upright(image: np.ndarray, pixels: np.ndarray, board: Board) -> np.ndarray:
    """Return a chessboard's corners, reordered to begin at the upper left black square."""
    inner = pixels.reshape(board.rows - 1, board.columns - 1, 2)
    largest = np.array(image.shape[::-1]) - 1

    def level(a: np.ndarray, b: np.ndarray) -> float:
        middle = np.round(0.5 * (a + b)).astype(int)
        x, y = np.clip(middle, 0, largest)
        return float(image[y, x])

    # the square inside the first four corners has the colour of the upper left one
    if level(inner[0, 0], inner[1, 1]) < level(inner[-1, -1], inner[-2, -2]):
        return pixels
    return pixels[::-1]


def _consistent(
    ids: np.ndarray, pixels: np.ndarray, table: np.ndarray, board: Board
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return numbers (n,) and pixels (n, 2) of the corners consistent with a plane, and the side of a square [px]."""
    points = table[ids, None, :2]
    plane, _ = cv2.findHomography(points[:, 0], pixels, cv2.RANSAC, 8.0)
    if plane is None:
        return ids[:0], pixels[:0], 1.0

    def mapped(shift: list[float]) -> np.ndarray:
        return cv2.perspectiveTransform((points + shift).astype(np.float64), plane)[:, 0]

    corner_pixels = mapped([0.0, 0.0])
    to_right = np.linalg.norm(mapped([board.square, 0.0]) - corner_pixels, axis=1)
    down = np.linalg.norm(mapped([0.0, board.square]) - corner_pixels, axis=1)
    sides = np.minimum(to_right, down)
    consistent = np.linalg.norm(corner_pixels - pixels, axis=1) < 0.5 * sides
    return ids[consistent], pixels[consistent], float(np.percentile(sides, 20))


def _refined(
    image: np.ndarray, board: Board, ids: np.ndarray, pixels: np.ndarray, spacing: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners refined to sub-pixels; corners at the image's edge or without convergence are dropped."""
    # half width of a corner's surroundings without other edges, in squares
    free = {"charuco": 0.5 * (1.0 - board.marker / board.square), "chessboard": 0.3, "apriltag": 0.09}[board.kind]
    half = int(np.clip(free * spacing, 2, 12))
    largest = np.array(image.shape[::-1]) - half - 3
    interior = ((pixels > half + 2) & (pixels < largest)).all(axis=1)
    ids, pixels = ids[interior], pixels[interior]
    if not len(ids):
        return ids, pixels
    start = pixels.astype(np.float32).reshape(-1, 1, 2)
    better = cv2.cornerSubPix(image, start.copy(), (half, half), (-1, -1), CRITERIA).reshape(-1, 2)
    converged = np.linalg.norm(better - pixels, axis=1) < max(2.0, 0.1 * spacing)
    return ids[converged], better[converged].astype(float)


def _quality(image: np.ndarray, pixels: np.ndarray, floor: float, spacing: float) -> tuple[np.ndarray, float, float]:
    """Return each corner's σ (n,) [px], the median edge width [px], and its ratio between the two directions."""
    half = int(np.clip(0.15 * spacing, 3, MAX_HALF_WIDTH))
    offsets = np.arange(-half, half + 1)
    middle = np.round(pixels).astype(int)
    height, width = image.shape
    rows = np.clip(middle[:, 1, None] + offsets, 0, height - 1)
    columns = np.clip(middle[:, 0, None] + offsets, 0, width - 1)
    patch = image[rows[:, :, None], columns[:, None, :]].astype(float)
    vertical, horizontal = np.gradient(patch, axis=(1, 2))
    flat = patch.reshape(len(patch), -1)
    contrast = np.percentile(flat, 95, axis=1) - np.percentile(flat, 5, axis=1)

    # noise of the 30 % of second differences where nothing is
    second = patch[:, :, 2:] - 2 * patch[:, :, 1:-1] + patch[:, :, :-2]
    noise = float(np.percentile(np.abs(second), 30)) / (0.3853 * np.sqrt(6.0))
    noise = max(noise, 0.3)
    xx = (horizontal**2).sum((1, 2))
    xy = (horizontal * vertical).sum((1, 2))
    yy = (vertical**2).sum((1, 2))
    determinant = np.maximum(xx * yy - xy**2, 1e-9)
    bound = noise * np.sqrt(0.5 * (xx + yy) / determinant)
    widths = np.array([_widths(*gradients) for gradients in zip(horizontal, vertical, contrast)])
    motion = np.median(widths.max(1) / widths.min(1))
    return np.hypot(floor, bound), float(np.median(widths)), float(motion)


def _widths(horizontal: np.ndarray, vertical: np.ndarray, contrast: float) -> tuple[float, float]:
    """Return the widths [px] of the two edges crossing in a patch: contrast divided by the steepest gradient across
    each.
    """
    size = np.hypot(horizontal, vertical)
    steepest = np.unravel_index(int(np.argmax(size)), size.shape)
    steepest_size = float(size[steepest])
    normal_x = horizontal[steepest] / max(steepest_size, 1e-9)
    normal_y = vertical[steepest] / max(steepest_size, 1e-9)
    is_across = np.abs(horizontal * normal_x + vertical * normal_y) < 0.7 * size
    main_gradient = float(np.percentile(size[~is_across], 98))
    cross_gradient = steepest_size
    if is_across.any():
        cross_gradient = float(np.percentile(size[is_across], 98))
    return contrast / max(main_gradient, 1e-3), contrast / max(cross_gradient, 1e-3)


def _absent(image: np.ndarray, coarse: np.ndarray, board: Board, count: int, thorough: bool) -> str:
    """Return the likely reason why no board was detected."""
    if count:
        return f"only {count} corners of the board are in view, {MIN_CORNERS} are needed: move it into view"
    sample = image[::5, ::5]
    if np.percentile(sample, 99) < 30:
        return "too dark: hardly anything is brighter than 30 of 255; expose longer"
    if np.mean(sample > 252) > 0.25:
        return "over-exposed: a quarter of the image is white or more; expose shorter"
    if thorough:
        mirrored, _ = _coarse(np.ascontiguousarray(coarse[:, ::-1]), board)
        if len(mirrored) >= MIN_CORNERS:
            return "the board is seen mirrored: is the image flipped, or seen in a mirror? Save it unflipped"
    if thorough and board.kind != "chessboard":
        marker_count = _markers(coarse, board.dictionary)
        if marker_count >= MIN_MARKERS:
            return (
                f"{marker_count} markers of {board.dictionary} are seen, but not where board.toml has them: are "
                "kind, columns and rows (squares, not inner corners) those of the print?"
            )
        dictionary_name = _other_dictionary(coarse, board)
        if dictionary_name:
            return (
                f"no markers of {board.dictionary}, but some of {dictionary_name}: state this dictionary in board.toml"
            )
    width = _sharpest(coarse)
    if width > 3.5:
        return f"no board found; the image's sharpest edges are {width:.0f} px wide: out of focus, or still moving"
    return "no board found: out of view, hidden, blurred or in glare"


def _other_dictionary(image: np.ndarray, board: Board) -> str:
    """Return the name of the dictionary with the most detected markers; "" if hardly any are detected."""
    family = board.dictionary.split("_")[0]
    counts = {}
    for name in DICTIONARIES:
        is_largest = name.endswith("_100") or name.startswith("apriltag_36h11")
        if is_largest and name.split("_")[0] != family:
            counts[name] = _markers(image, name)
    best = max(counts, key=lambda name: counts[name])
    if counts[best] < MIN_MARKERS:
        return ""
    return best


def _markers(image: np.ndarray, name: str) -> int:
    """Return the number of detected markers of a dictionary in an image."""
    _, ids, _ = cv2.aruco.ArucoDetector(dictionary(name)).detectMarkers(image)
    if ids is None:
        return 0
    return len(ids)


def _sharpest(image: np.ndarray) -> float:
    """Return the width of the sharpest edges of an image [px]: its contrast over its steepest gradients."""
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 0.8)
    horizontal = cv2.Sobel(smooth, cv2.CV_32F, 1, 0) / 8.0
    vertical = cv2.Sobel(smooth, cv2.CV_32F, 0, 1) / 8.0
    low, high = np.percentile(smooth, [1, 99.5])
    gradient = float(np.percentile(np.hypot(horizontal, vertical), 99.9))
    return float((high - low) / max(gradient, 1e-3))


def detected(
    images: Iterable[tuple[str, Path | np.ndarray]],
    board: Board,
    count: int = 0,
    progress: Callable[[int, int, str], None] | None = None,
) -> Found:
    """Detect a board in images (files or arrays) and return the corners by image name.

    Images whose size differs from that of most images are marked as unusable: a lens is valid for one image size.
    """
    detections = dict[str, Detection]()
    sizes = dict[str, tuple[int, int]]()
    failures = 0
    blank = np.full((len(corners(board)), 2), np.nan)
    for number, (name, source) in enumerate(images):
        if progress:
            progress(number, count, name)
        try:
            image = read_image(source) if isinstance(source, Path) else source
        except MeasurementError as error:
            problem = str(error).removeprefix(f"{source}: ")
            detections[name] = Detection(blank, blank[:, 0], problem)
            continue
        height, width = image.shape[:2]
        sizes[name] = width, height
        detection = detect(image, board, thorough=failures < MAX_EXAMINED)
        detections[name] = detection
        failures += detection.problem.startswith("no board found")
    if not sizes:
        return Found(detections)
    ((usual_size, _),) = Counter(sizes.values()).most_common(1)
    for name, size in sizes.items():
        if size != usual_size:
            hint = "; did a program rotate it?" if size == usual_size[::-1] else ""
            problem = f"{size[0]} x {size[1]} pixels, where most are {usual_size[0]} x {usual_size[1]}{hint}"
            detections[name] = Detection(blank, blank[:, 0], problem)
    return Found(detections, usual_size)
