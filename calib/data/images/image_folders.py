"""Reading a folder of images of a board with the joint values of each image.

==================  ===================================================================================================
``*.png`` …         the images (png, jpg, tif, bmp, pgm, webp), as the sensor gave them
``joints.csv``      ``image`` (the file's name), then the joints as in every measurement file: ``q1 [deg]`` …
``board.toml``      the board (`calib board` writes it)
``camera.yaml``     the lens as ROS ``camera_info``; without it, it is found from the images
``corners.csv``     the corners found; written at the first reading, read instead of the images afterwards; remove it
                    to have the images looked at again
==================  ===================================================================================================

One folder is one camera that sees one board. Whether the arm carries the camera or the board is found from the
measurements, unless the options say so ([camera] mounting). A board of another size than ``board.toml`` says changes
every length of the robot with it: measure the print.
"""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from calib.data.csv_table import Table, read_table
from calib.data.images.board import Board, corners, read_board
from calib.data.images.coverage import coverage_words
from calib.data.images.lens import LENS, Lens, read_lens
from calib.data.images.pixels import Found, Pixels, read_corners, write_corners
from calib.data.poses import BOARD, CORNERS, JOINTS, plausible
from calib.data.poses.columns import Sheet
from calib.data.poses.fit_options import FileOptions
from calib.data.schema import Joints
from calib.errors import CalibError, MeasurementError, UsageError, counted, listing, require

# A number that is no part of a name.
MEASURED = re.compile(r"(?<![\w.])\d+(?:\.\d+)?(?![\w.]*_)")
# Usable images below which a folder is refused.
MIN_IMAGES = 3
Progress = Callable[[int, int, str], None]


def read_images(
    path: str | Path,
    joints: Joints | Sequence[str],
    options: FileOptions | None = None,
    *,
    progress: Progress | None = None,
) -> Pixels:
    """Return the measurements of a folder of images for a robot with these joints.

    Args:
        path: the folder.
        joints: the robot's joints, or their names, as in `calib.data.poses.pose_files.read_measurements`.
        options: options for reading; their table [camera] concerns images.
        progress: called with (done, total, image).

    Raises:
        MeasurementError: if a file is missing or invalid, or fewer than three images are usable.
    """
    path = Path(path)
    robot = Joints.of(joints)
    options = options or FileOptions()
    board = read_own_board(path)
    table = joint_table(path)
    sheet = Sheet(table, options)
    q, columns = sheet.joints(robot.names)
    notes = list(plausible.check_joints(q, sheet, columns, robot))
    names = table.texts("image")
    detection = find_corners(path, board, names, progress)
    rows, detection_notes = _usable(names, detection, path)
    notes += detection_notes
    lens, lens_stated = _own_lens(path, detection.size, options)
    usable = [detection.images[names[row]] for row in rows]
    size = detection.size
    if not size[0]:
        size = lens.size if lens else (0, 0)
    return Pixels(
        q[rows],
        columns,
        np.array([image.pixel for image in usable]),
        board,
        lens,
        mounting=options.camera.mounting.replace("auto", ""),
        sigma=np.array([image.sigma for image in usable]),
        names=tuple(names),
        size=size,
        known=lens_stated,
        free=_free(options, lens_stated),
        model=options.camera.model,
        tool_names=(options.tool,),
        station=options.station or path.name,
        file=str(path),
        rows=table.rows[rows],
        notes=tuple(notes),
    )


def read_own_board(path: Path) -> Board:
    """Return the board of the folder's ``board.toml``.

    Raises:
        MeasurementError: if there is no such file.
    """
    message = f"has no {BOARD}, which describes the board: copy the one that calib board wrote into it"
    require((path / BOARD).is_file(), message, MeasurementError, path)
    return read_board(path)


def joint_table(path: Path) -> Table:
    """Return the table of the folder's ``joints.csv``."""
    file = path / JOINTS
    message = f"has no {JOINTS}: a table of image, q1 [deg] ... is needed, one row per image with its joint values"
    require(file.is_file(), message, MeasurementError, path)
    table = read_table(file)
    for name, count in Counter(table.texts("image")).items():
        if count > 1:
            raise MeasurementError(f"'{name}' occurs {count} times: one row per image is needed", file, column="image")
    return table


def find_corners(path: Path, board: Board, names: Sequence[str], progress: Progress | None = None) -> Found:
    """Return the corners of a folder's images: from ``corners.csv`` if newer than the images, else by detection.

    Args:
        path: the folder.
        board: the board to look for.
        names: file names of the images.
        progress: called with (done, total, image).
    """
    stored = path / CORNERS
    images = [path / name for name in names if (path / name).is_file()]
    if stored.is_file():
        newest = max(file.stat().st_mtime for file in (*images, path / BOARD))
        detection = read_corners(stored, board)
        all_stored = {image.name for image in images} <= set(detection.images)
        if all_stored and stored.stat().st_mtime >= newest:
            return detection
    if not images:
        missing = "images"
        if names:
            missing = f"'{names[0]}' and the others" if len(names) > 1 else f"'{names[0]}'"
        raise MeasurementError(f"none of the images named in {JOINTS} exists ({missing})", path)
    # Loads OpenCV: only where images are looked at.
    from calib.data.images.detection import detected

    detection = detected(((image.name, image) for image in images), board, len(images), progress)
    # A folder that cannot be written into is read all the same.
    with suppress(CalibError):
        write_corners(stored, detection)
    return detection


def _usable(names: Sequence[str], detection: Found, path: Path) -> tuple[np.ndarray, list[str]]:
    """Return the rows of ``joints.csv`` whose images are usable, and sentences on the unusable images."""
    missing = [name for name in names if name not in detection.images]
    problems = {name: detection.images[name].problem for name in names if name in detection.images}
    rows = np.array([k for k, name in enumerate(names) if problems.get(name) == ""], dtype=int)
    notes = []
    if missing:
        notes.append(f"{len(missing)} of {len(names)} rows have no image: {listing(missing, 5)}")
    extra = sorted(set(detection.images) - set(names))
    if extra:
        notes.append(f"{len(extra)} images have no row in {JOINTS}: {listing(extra, 5)}")
    notes += problem_words(problems)
    if len(rows) < MIN_IMAGES:
        reasons = "; ".join(notes) or "there are no more rows"
        raise MeasurementError(
            f"{counted(len(rows), 'usable image')}: a calibration takes 20 to 40 from all "
            f"around, at least {MIN_IMAGES} ({reasons})",
            path,
        )
    return rows, notes


def problem_words(problems: Mapping[str, str]) -> list[str]:
    """Return a sentence per reason why images are unusable, with the names of the images concerned."""
    reasons: dict[str, list[str]] = {}
    for name, problem in problems.items():
        if problem:
            reasons.setdefault(MEASURED.sub("#", problem), []).append(name)
    result = []
    for reason, names in reasons.items():
        numbers = [MEASURED.findall(problems[name]) for name in names]
        for numerals in zip(*numbers):
            low, high = min(numerals, key=float), max(numerals, key=float)
            number_range = low if low == high else f"{low} to {high}"
            reason = reason.replace("#", number_range, 1)
        images = "images are" if len(names) > 1 else "image is"
        result.append(f"{len(names)} {images} not usable ({reason}): {listing(names, 5)}")
    return result


def _own_lens(path: Path, size: tuple[int, int], options: FileOptions) -> tuple[Lens | None, bool]:
    """Return the folder's lens and whether it was given by the user; None if the lens must be estimated from the
    images.
    """
    file = path / LENS
    if not file.is_file():
        if options.camera.intrinsics == "given":
            raise MeasurementError(f"has no {LENS}, required by intrinsics = 'given'", path)
        return None, False
    lens = read_lens(file)
    if size[0] and lens.size != size:
        raise MeasurementError(
            f"is for images of {lens.size[0]} x {lens.size[1]} pixels, but the images here have {size[0]} x {size[1]}",
            file,
        )
    return lens, True


def _free(options: FileOptions, lens_stated: bool) -> tuple[str, ...]:
    """Return the names of the lens and board parameters that the options ask to fit."""
    camera = options.camera
    result: list[str] = []
    if camera.intrinsics == "fit" or (camera.intrinsics == "auto" and not lens_stated):
        distortion = {"pinhole": ("k1", "k2", "p1", "p2"), "fisheye": ("k1", "k2", "k3", "k4")}
        result += ["fx", "fy", "cx", "cy", *distortion[camera.model]]
    if "scale" in camera.board:
        result.append("scale")
    if "bend" in camera.board:
        result += ["bend_xx", "bend_xy", "bend_yy"]
    return tuple(result)


def look(folder: Path, show: Callable[[str], None]) -> list[str]:
    """Return a summary of the corner detection in a folder of images, as sentences."""
    board = read_own_board(folder)
    if (folder / JOINTS).exists():
        names = joint_table(folder).texts("image")
    else:
        names = _images(folder)
    detection = find_corners(folder, board, names, lambda done, total, name: show(f"{done} of {total}: {name}"))
    return detection_summary(detection, board, names)


def _images(folder: Path) -> list[str]:
    from calib.data.images.images import SUFFIXES

    names = sorted(path.name for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)
    require(names, f"{folder}: there is neither a {JOINTS} nor an image ({', '.join(SUFFIXES)})", UsageError)
    return names


def detection_summary(detection: Found, board: Board, names: Iterable[str]) -> list[str]:
    """Return sentences on detected corners: number of usable images, reasons for unusable ones, coverage of the image.

    Raises:
        MeasurementError: if no image is usable, with the reasons.
    """
    usable = [image for image in detection.images.values() if not image.problem]
    total = len(corners(board))
    count = len(list(names))
    problems = problem_words({name: image.problem for name, image in detection.images.items()})
    if not usable:
        raise MeasurementError("; ".join([f"none of {count} images is usable ({board.words})", *problems]))
    corner_counts = np.array([image.seen.sum() for image in usable])
    sigma = float(np.nanmedian(np.concatenate([image.sigma[image.seen] for image in usable])))
    edge = float(np.nanmedian([image.edge for image in usable]))
    quality = f"each to about {sigma:.2f} px; edges {edge:.1f} px wide"
    lines = [
        f"{len(usable)} of {count} images are usable ({board.words})",
        f"{corner_counts.mean():.1f} of {total} corners per image, {quality}",
    ]
    if detection.size[0]:
        pixels = np.concatenate([image.pixel[image.seen] for image in usable])
        lines.append(coverage_words(pixels, detection.size))
    return [*lines, *problems]
