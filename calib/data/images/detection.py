"""Sub-pixel corner detection: a board's corners in an image with their σ, or the reason why it is unusable.

Markers are detected in an image reduced to about `MAX_PIXELS` pixels. Corners are then refined in the full image by the
orthogonality of gradients (Förstner & Gülch 1987; OpenCV's cornerSubPix). The variance of a corner is the Cramér–Rao
bound of the patch around it, n² (Σ g gᵀ)⁻¹ with grey-level noise n and gradients g; it is at least `FLOOR`².
"""

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from calib.data.images.board import MIN_CORNERS, Board, corners
from calib.data.images.board_print import charuco, dictionary
from calib.data.images.images import quiet, read_image
from calib.data.images.marker_layout import (
    INNER,
    OLD_PATTERN,
    exchange_words,
    has_two_patterns,
    layout_words,
    other_dictionary,
)
from calib.data.images.pixels import Detection, Detections
from calib.errors import MeasurementError
from calib.workers.extras import needing

with needing("cv2"):
    import cv2

# Lower bound of a corner's sigma [px]; tags' corners move with blur.
FLOOR = {"charuco": 0.02, "chessboard": 0.02, "apriltag": 0.2}
# Smallest share of the detected corners that are consistent with a flat board of the stated size.
MIN_CONSISTENT = 0.6
# Width of the edges [px] from which on an image is refused.
BLURRED = 7.0
# Ratio of the edges' widths in two directions from which on blur is attributed to motion.
MOTION_RATIO = 1.8
# Number of pixels to which an image is reduced before markers are detected (our choice).
MAX_PIXELS = 1.5e6
# Largest half width of the patches in which a corner's quality is measured [px].
MAX_HALF_WIDTH = 9
# Number of images without a board that are examined for other and mirrored boards; the search is slow.
MAX_EXAMINED = 3
# Half widths of a corner's surroundings without other edges, in squares; of a ChArUco board see `_refined`.
FREE_SHARES = {"chessboard": 0.3, "apriltag": 0.09}
# Smallest noise of an image [grey levels].
MIN_NOISE = 0.3
# Ratio of the 30 % quantile of |x| to σ, and of the noise of a second difference to that of a pixel.
QUANTILE_30 = 0.3853
SECOND_DIFFERENCE = np.sqrt(6.0)
# Grey level below which an image is too dark, level and share from which on it is over-exposed.
DARK = 30
WHITE = 252
MAX_WHITE_SHARE = 0.25
# Width of the sharpest edges [px] from which on an image without a board is called out of focus.
UNSHARP = 3.5
# Settings of OpenCV's refinement of a corner: at most 40 iterations, down to steps of 1e-3 px.
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
    full_size = np.array(image.shape[::-1])
    coarse_size = np.array(coarse.shape[::-1])
    scale = full_size / coarse_size
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

    detected_count = len(ids)
    ids, pixels, spacing = _consistent(ids, pixels, table, board)
    if len(ids) < MIN_CONSISTENT * detected_count:
        counts = f"{len(ids)} of {detected_count} corners"
        reason = layout_words(coarse, board) or f"only {counts} lie where board.toml has them"
        return Detection(no_pixels, no_sigmas, problem=reason)
    ids, pixels = _refined(image, board, ids, pixels, spacing)
    if len(ids) < min_corners:
        reason = f"only {len(ids)} of {len(table)} corners are sharp enough: blurred, or too small"
        return Detection(no_pixels, no_sigmas, problem=reason)
    floor = FLOOR[board.kind]
    sigma, edge, motion = _quality(image, pixels, floor, spacing)
    pixel = no_pixels
    sigmas = no_sigmas
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
    """Return the numbers (n,) of the detected corners in the board's table, and their pixels (n, 2), not refined."""
    nothing = np.zeros(0, dtype=int), np.zeros((0, 2))
    if board.kind == "chessboard":
        columns = board.columns - 1
        rows = board.rows - 1
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE
        success, pixels = cv2.findChessboardCornersSB(image, (columns, rows), flags=flags)
        if not success:
            return nothing
        return np.arange(columns * rows), _upright(image, pixels.reshape(-1, 2), board)
    if board.kind == "charuco":
        with quiet():
            charuco_detector = cv2.aruco.CharucoDetector(charuco(board))
            pixels, ids, _, _ = charuco_detector.detectBoard(image)
        if ids is None:
            return nothing
        return ids.ravel(), np.asarray(pixels).reshape(-1, 2)

    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(dictionary(board.dictionary), parameters)
    tag_pixels, tags, _ = detector.detectMarkers(image)
    if tags is None:
        return nothing
    ids = []
    pixels = []
    for tag, corners_of_tag in zip(tags.ravel().tolist(), tag_pixels):
        if tag < board.tags:
            ids.append(4 * tag + np.arange(4))
            pixels.append(corners_of_tag.reshape(4, 2))
    if not ids:
        return nothing
    return np.concatenate(ids), np.concatenate(pixels)


def _upright(image: np.ndarray, pixels: np.ndarray, board: Board) -> np.ndarray:
    """Return a chessboard's corners (n, 2) [px] in the order that begins at the board's upper left black square.

    OpenCV may begin at either end; then the order is reversed.
    """
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
    """Return the corners that are consistent with a flat board, and the side of a square.

    Args:
        ids: (n,) numbers of the detected corners.
        pixels: (n, 2) pixels of the detected corners.
        table: (K, 3) positions of all corners of the board [m].
        board: the board.

    Returns:
        Numbers and pixels of the consistent corners, and the 20 % quantile of the squares' sides [px].
    """
    points = table[ids, None, :2]
    plane, _ = cv2.findHomography(points[:, 0], pixels, cv2.RANSAC, 8.0)
    if plane is None:
        return ids[:0], pixels[:0], 1.0

    def mapped(shift: list[float]) -> np.ndarray:
        shifted = (points + shift).astype(np.float64)
        return cv2.perspectiveTransform(shifted, plane)[:, 0]

    corner_pixels = mapped([0.0, 0.0])
    square_to_right = mapped([board.square, 0.0]) - corner_pixels
    square_down = mapped([0.0, board.square]) - corner_pixels
    width = np.linalg.norm(square_to_right, axis=1)
    height = np.linalg.norm(square_down, axis=1)
    sides = np.minimum(width, height)
    error = np.linalg.norm(corner_pixels - pixels, axis=1)
    consistent = error < 0.5 * sides
    spacing = float(np.percentile(sides, 20))
    return ids[consistent], pixels[consistent], spacing


def _refined(
    image: np.ndarray, board: Board, ids: np.ndarray, pixels: np.ndarray, spacing: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return numbers and pixels of the corners refined to sub-pixels.

    Corners at the image's edge, and corners whose refinement does not converge, are omitted.

    Args:
        image: (height, width) 8-bit grey.
        board: the board.
        ids: (n,) numbers of the corners.
        pixels: (n, 2) pixels before refinement.
        spacing: side of a square [px].
    """
    if board.kind == "charuco":
        # half of the gap between a marker and its square
        free = 0.5 * (1.0 - board.marker / board.square)
    else:
        free = FREE_SHARES[board.kind]
    half = int(np.clip(free * spacing, 2, 12))
    largest = np.array(image.shape[::-1]) - half - 3
    inside = (pixels > half + 2) & (pixels < largest)
    interior = inside.all(axis=1)
    ids = ids[interior]
    pixels = pixels[interior]
    if not len(ids):
        return ids, pixels
    start = pixels.astype(np.float32).reshape(-1, 1, 2)
    refined = cv2.cornerSubPix(image, start.copy(), (half, half), (-1, -1), CRITERIA)
    better = refined.reshape(-1, 2)
    step = np.linalg.norm(better - pixels, axis=1)
    converged = step < max(2.0, 0.1 * spacing)
    return ids[converged], better[converged].astype(float)


def _quality(image: np.ndarray, pixels: np.ndarray, floor: float, spacing: float) -> tuple[np.ndarray, float, float]:
    """Return the σ of each corner (n,) [px], and two measures of blur.

    Args:
        image: (height, width) 8-bit grey.
        pixels: (n, 2) refined corners.
        floor: lower bound of σ [px].
        spacing: side of a square [px].

    Returns:
        σ of each corner, median width of the edges [px], and median ratio of the widths of a corner's two edges.
    """
    half = int(np.clip(0.15 * spacing, 3, MAX_HALF_WIDTH))
    offsets = np.arange(-half, half + 1)
    middle = np.round(pixels).astype(int)
    height, width = image.shape
    middle_row = middle[:, 1, None]
    middle_column = middle[:, 0, None]
    rows = np.clip(middle_row + offsets, 0, height - 1)
    columns = np.clip(middle_column + offsets, 0, width - 1)
    patch = image[rows[:, :, None], columns[:, None, :]]
    patch = patch.astype(float)
    vertical, horizontal = np.gradient(patch, axis=(1, 2))
    flat = patch.reshape(len(patch), -1)
    bright = np.percentile(flat, 95, axis=1)
    dark = np.percentile(flat, 5, axis=1)
    contrast = bright - dark

    # noise from the smallest 30 % of the second differences, which lie in plain areas
    second = patch[:, :, 2:] - 2 * patch[:, :, 1:-1] + patch[:, :, :-2]
    quantile = float(np.percentile(np.abs(second), 30))
    noise = quantile / (QUANTILE_30 * SECOND_DIFFERENCE)
    noise = max(noise, MIN_NOISE)
    xx = (horizontal**2).sum((1, 2))
    xy = (horizontal * vertical).sum((1, 2))
    yy = (vertical**2).sum((1, 2))
    determinant = np.maximum(xx * yy - xy**2, 1e-9)
    bound = noise * np.sqrt(0.5 * (xx + yy) / determinant)
    corner_widths = []
    for across, down, difference in zip(horizontal, vertical, contrast):
        corner_widths.append(_widths(across, down, difference))
    widths = np.array(corner_widths)
    ratio = widths.max(1) / widths.min(1)
    sigma = np.hypot(floor, bound)
    return sigma, float(np.median(widths)), float(np.median(ratio))


def _widths(horizontal: np.ndarray, vertical: np.ndarray, contrast: float) -> tuple[float, float]:
    """Return the widths [px] of the two edges that cross in a patch around a corner.

    A width is the contrast divided by the steepest gradient across the edge.

    Args:
        horizontal, vertical: (h, h) gradients of the patch [grey levels per px].
        contrast: difference of white and black in the patch [grey levels].
    """
    size = np.hypot(horizontal, vertical)
    steepest = np.unravel_index(int(np.argmax(size)), size.shape)
    steepest_size = float(size[steepest])
    normal_x = horizontal[steepest] / max(steepest_size, 1e-9)
    normal_y = vertical[steepest] / max(steepest_size, 1e-9)
    along_normal = horizontal * normal_x + vertical * normal_y
    is_across = np.abs(along_normal) < 0.7 * size
    main_gradient = float(np.percentile(size[~is_across], 98))
    cross_gradient = steepest_size
    if is_across.any():
        cross_gradient = float(np.percentile(size[is_across], 98))
    main_width = contrast / max(main_gradient, 1e-3)
    cross_width = contrast / max(cross_gradient, 1e-3)
    return main_width, cross_width


def _absent(image: np.ndarray, coarse: np.ndarray, board: Board, count: int, thorough: bool) -> str:
    """Return the likely reason why no board was detected, as text.

    Args:
        image: (height, width) 8-bit grey.
        coarse: the image, reduced in size.
        board: the board that was looked for.
        count: number of corners that were detected.
        thorough: whether to look for mirrored boards and for markers of other dictionaries.
    """
    if count:
        return f"only {count} corners of the board are in view, {MIN_CORNERS} are needed: move it into view"
    if thorough and board.kind != "chessboard":
        exchange = exchange_words(coarse, board)
        if exchange:
            return exchange
    sample = image[::5, ::5]
    if np.percentile(sample, 99) < DARK:
        return "too dark: hardly anything is brighter than 30 of 255; expose longer"
    if np.mean(sample > WHITE) > MAX_WHITE_SHARE:
        return "over-exposed: a quarter of the image is white or more; expose shorter"
    if thorough:
        mirror_image = np.ascontiguousarray(coarse[:, ::-1])
        mirrored, _ = _coarse(mirror_image, board)
        if len(mirrored) >= MIN_CORNERS:
            return "the board is seen mirrored: is the image flipped, or seen in a mirror? Save it unflipped"
    if thorough and board.kind != "chessboard":
        layout = layout_words(coarse, board)
        if layout:
            return layout
        dictionary_name = other_dictionary(coarse, board)
        if dictionary_name:
            return (
                f"no markers of {board.dictionary}, but some of {dictionary_name}: state this dictionary in board.toml"
            )
    if thorough and board.kind == "chessboard":
        with_more = replace(board, columns=board.columns + 1, rows=board.rows + 1)
        ids, _ = _coarse(coarse, with_more)
        if len(ids):
            return (
                f"a chessboard of {with_more.columns} x {with_more.rows} squares is seen: {INNER}; state columns = "
                f"{with_more.columns}, rows = {with_more.rows} in board.toml"
            )
    width = _sharpest(coarse)
    if width > UNSHARP:
        return f"no board found; the image's sharpest edges are {width:.0f} px wide: out of focus, or still moving"
    return "no board found: out of view, hidden, blurred or in glare"


def _sharpest(image: np.ndarray) -> float:
    """Return the width of the sharpest edges of an image [px]: its contrast over its steepest gradients."""
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 0.8)
    horizontal = cv2.Sobel(smooth, cv2.CV_32F, 1, 0) / 8.0
    vertical = cv2.Sobel(smooth, cv2.CV_32F, 0, 1) / 8.0
    low, high = np.percentile(smooth, [1, 99.5])
    size = np.hypot(horizontal, vertical)
    gradient = float(np.percentile(size, 99.9))
    return float((high - low) / max(gradient, 1e-3))


def detected(
    images: Iterable[tuple[str, Path | np.ndarray]],
    board: Board,
    count: int = 0,
    progress: Callable[[int, int, str], None] | None = None,
) -> Detections:
    """Return the corners of a board detected in images, by image name.

    Images whose size differs from that of most images are marked as unusable: a lens is valid for one image size. Of a
    ChArUco board that differs between versions of OpenCV, the pattern of the first image with a board is taken.

    Args:
        images: name of each image, with its file or its grey levels (height, width).
        board: the board to look for.
        count: number of images, for `progress`.
        progress: called with (done, total, image); None: not called.
    """
    detections = dict[str, Detection]()
    sizes = dict[str, tuple[int, int]]()
    failures = 0
    other_pattern = None
    if has_two_patterns(board):
        other_pattern = replace(board, legacy=not board.legacy)
    notes: tuple[str, ...] = ()
    blank = np.full((len(corners(board)), 2), np.nan)
    for number, (name, source) in enumerate(images):
        if progress:
            progress(number, count, name)
        try:
            if isinstance(source, Path):
                image = read_image(source)
            else:
                image = source
        except MeasurementError as error:
            problem = str(error).removeprefix(f"{source}: ")
            detections[name] = Detection(blank, blank[:, 0], problem)
            continue
        height, width = image.shape[:2]
        sizes[name] = width, height
        detection = detect(image, board, thorough=False)
        if detection.problem and other_pattern is not None:
            other_detection = detect(image, other_pattern, thorough=False)
            if not other_detection.problem:
                detection = other_detection
                board = other_pattern
                notes = (_pattern_note(board),)
        if not detection.problem:
            other_pattern = None
        elif failures < MAX_EXAMINED:
            detection = detect(image, board)
        detections[name] = detection
        failures += detection.problem.startswith("no board found")
    if not sizes:
        return Detections(detections)
    ((usual_size, _),) = Counter(sizes.values()).most_common(1)
    for name, size in sizes.items():
        if size != usual_size:
            hint = ""
            if size == usual_size[::-1]:
                hint = "; did a program rotate it?"
            problem = f"{size[0]} x {size[1]} pixels, where most are {usual_size[0]} x {usual_size[1]}{hint}"
            detections[name] = Detection(blank, blank[:, 0], problem)
    return Detections(detections, usual_size, notes)


def _pattern_note(board: Board) -> str:
    """Return the remark that images show the other pattern of a ChArUco board than ``board.toml`` states."""
    value = "true" if board.legacy else "false"
    words = OLD_PATTERN if board.legacy else "the pattern is that of OpenCV from 4.6"
    return f"{words}; the images are read so: state legacy = {value} in board.toml"
