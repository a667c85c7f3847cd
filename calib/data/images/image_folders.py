"""Reading a folder of images of a board with the joint values of each image.

==================  ===================================================================================================
``*.png`` …         the images (png, jpg, tif, bmp, pgm, webp), as the sensor gave them
``joints.csv``      ``image`` (the file's name), then the joints as in every measurement file: ``q1 [deg]`` …
``board.toml``      the board (`calib board` writes it)
``camera.yaml``     the lens as ROS ``camera_info``; files of OpenCV, kalibr and RealSense are read too, under any name
                    (``.yaml .yml .xml .json``); without one, the lens is found from the images
``corners.csv``     the corners found; written at the first reading, read instead of the images afterwards, also where
                    the images are gone; remove it to have the images looked at again
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
from calib.data.images.lens import LENS, Lens
from calib.data.images.lens_files import read_lens
from calib.data.images.pixels import Detections, Pixels, read_corners, write_corners
from calib.data.poses import BOARD, CORNERS, JOINTS, plausible
from calib.data.poses.columns import Sheet
from calib.data.poses.fit_options import FileOptions
from calib.data.schema import Joints
from calib.errors import CalibError, MeasurementError, UsageError, counted, listing, require

# A number that is not part of a name.
MEASURED = re.compile(r"(?<![\w.])\d+(?:\.\d+)?(?![\w.]*_)")
# Files of a folder that may have the lens, where there is no ``camera.yaml``.
LENS_SUFFIXES = (".yaml", ".yml", ".xml", ".json")
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
    q, columns = sheet.joints(robot)
    notes = list(plausible.check_joints(q, sheet, columns, robot))
    names = table.texts("image")
    detection = find_corners(path, board, names, progress)
    rows, detection_notes = _usable(names, detection, path)
    notes += [*detection.notes, *detection_notes]
    lens, lens_stated, lens_notes = _lens_of_folder(path, detection.size, options)
    notes += lens_notes
    pixels = []
    sigmas = []
    for row in rows:
        image = detection.images[names[row]]
        pixels.append(image.pixel)
        sigmas.append(image.sigma)
    size = detection.size
    if not size[0] and lens is not None:
        size = lens.size
    mounting = options.camera.mounting
    if mounting == "auto":
        mounting = ""
    return Pixels(
        q[rows],
        columns,
        np.array(pixels),
        board,
        lens,
        mounting=mounting,
        sigma=np.array(sigmas),
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


def find_corners(path: Path, board: Board, names: Sequence[str], progress: Progress | None = None) -> Detections:
    """Return the corners of a folder's images: from ``corners.csv`` if newer than the images, else by detection.

    A folder without images is read from its ``corners.csv``, however old.

    Args:
        path: the folder.
        board: the board to look for.
        names: file names of the images.
        progress: called with (done, total, image).

    Raises:
        MeasurementError: if there are neither images nor corners of them.
    """
    stored = path / CORNERS
    images = [path / name for name in names if (path / name).is_file()]
    if stored.is_file() and not images:
        return _stored_corners(stored, board, names)
    if stored.is_file():
        times = [file.stat().st_mtime for file in (*images, path / BOARD)]
        newest = max(times)
        # with another board, the stored corners may be none of it
        if stored.stat().st_mtime >= newest:
            detection = read_corners(stored, board)
            if all(image.name in detection.images for image in images):
                return detection
    if not images:
        missing = "images"
        if len(names) == 1:
            missing = f"'{names[0]}'"
        elif names:
            missing = f"'{names[0]}' and the others"
        raise MeasurementError(f"none of the images named in {JOINTS} exists ({missing})", path)
    # Loads OpenCV, which is slow: only where images are read.
    from calib.data.images.detection import detected

    named_images = [(image.name, image) for image in images]
    detection = detected(named_images, board, len(images), progress)
    # The detection is valid even if the folder cannot be written into.
    with suppress(CalibError):
        write_corners(stored, detection)
    return detection


def _stored_corners(file: Path, board: Board, names: Sequence[str]) -> Detections:
    """Return the corners in the ``corners.csv`` of a folder without images.

    Args:
        file: the ``corners.csv``.
        board: the board.
        names: file names of the images in ``joints.csv``.

    Raises:
        MeasurementError: if the file has corners of none of these images.
    """
    detection = read_corners(file, board)
    if detection.images.keys() & set(names):
        return detection
    others = listing(detection.images, 3) or "no images"
    raise MeasurementError(
        f"{JOINTS} and {CORNERS} disagree: {JOINTS} names {listing(names, 3)}, {CORNERS} has {others}, and there are "
        "no images: give the images the same names in both",
        file.parent,
    )


def _usable(names: Sequence[str], detection: Detections, path: Path) -> tuple[np.ndarray, list[str]]:
    """Return the rows of ``joints.csv`` whose images are usable, and sentences on the unusable images."""
    missing = []
    problems = {}
    usable = []
    for row, name in enumerate(names):
        image = detection.images.get(name)
        if image is None:
            missing.append(name)
            continue
        problems[name] = image.problem
        if not image.problem:
            usable.append(row)
    rows = np.array(usable, dtype=int)
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
    """Return a sentence per reason why images are unusable, with the names of the images concerned.

    Args:
        problems: reason by image name; "" for a usable image. Reasons that differ in their numbers only are reported as
            one, with the range of the numbers.
    """
    reasons: dict[str, list[str]] = {}
    for name, problem in problems.items():
        if problem:
            reason = MEASURED.sub("#", problem)
            reasons.setdefault(reason, []).append(name)
    result = []
    for reason, names in reasons.items():
        numbers = [MEASURED.findall(problems[name]) for name in names]
        for numerals in zip(*numbers):
            low = min(numerals, key=float)
            high = max(numerals, key=float)
            number_range = f"{low} to {high}"
            if low == high:
                number_range = low
            reason = reason.replace("#", number_range, 1)
        images = "image is"
        if len(names) > 1:
            images = "images are"
        result.append(f"{len(names)} {images} not usable ({reason}): {listing(names, 5)}")
    return result


def _lens_of_folder(path: Path, size: tuple[int, int], options: FileOptions) -> tuple[Lens | None, bool, list[str]]:
    """Return the lens of a folder's ``camera.yaml`` or other file with a lens, and whether there is such a file.

    Args:
        path: the folder.
        size: width and height of the images [px]; 0, 0: unknown.
        options: options for reading.

    Returns:
        Lens, True and remarks; None, False and remarks without a file: then the lens has to be estimated from the
        images.
    """
    file = path / LENS
    notes = []
    if not file.is_file():
        other, notes = _other_lens_file(path, size)
        if other is None:
            if options.camera.intrinsics == "given":
                raise MeasurementError(f"has no {LENS}, required by intrinsics = 'given'", path)
            return None, False, notes
        file = other
    lens = read_lens(file, size)
    if size[0] and lens.size != size:
        raise MeasurementError(
            f"is for images of {lens.size[0]} x {lens.size[1]} pixels, but the images here have {size[0]} x {size[1]}",
            file,
        )
    return lens, True, notes


def _other_lens_file(path: Path, size: tuple[int, int]) -> tuple[Path | None, list[str]]:
    """Return the only file of a folder with a lens, whatever its name, and remarks on what was read and what was not.

    Args:
        path: the folder.
        size: width and height of the images [px]; 0, 0: unknown.
    """
    lenses = []
    notes = []
    for file in sorted(path.iterdir()):
        if file.suffix.lower() not in LENS_SUFFIXES:
            continue
        try:
            read_lens(file, size)
        except MeasurementError as error:
            notes.append(f"{file.name} is not read as a lens: {str(error).removeprefix(f'{file}: ')}")
        else:
            lenses.append(file)
    if len(lenses) > 1:
        names = listing([file.name for file in lenses], 5)
        raise MeasurementError(f"has several files with a lens ({names}): name that of these images {LENS}", path)
    if not lenses:
        return None, notes
    return lenses[0], [*notes, f"the lens is read from {lenses[0].name}"]


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

    def show_progress(done: int, total: int, name: str) -> None:
        show(f"{done} of {total}: {name}")

    detection = find_corners(folder, board, names, show_progress)
    return detection_summary(detection, board, names)


def _images(folder: Path) -> list[str]:
    """Return the names of a folder's images, sorted; raise UsageError if there are none."""
    from calib.data.images.images import SUFFIXES

    names = sorted(path.name for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)
    require(names, f"{folder}: there is neither a {JOINTS} nor an image ({', '.join(SUFFIXES)})", UsageError)
    return names


def detection_summary(detection: Detections, board: Board, names: Iterable[str]) -> list[str]:
    """Return sentences on detected corners: number of usable images, reasons for unusable ones, coverage of the image.

    Raises:
        MeasurementError: if no image is usable, with the reasons.
    """
    corner_counts = []
    sigmas = []
    edges = []
    pixels = []
    reasons = {}
    for name, image in detection.images.items():
        reasons[name] = image.problem
        if image.problem:
            continue
        corner_counts.append(image.seen.sum())
        sigmas.append(image.sigma[image.seen])
        pixels.append(image.pixel[image.seen])
        edges.append(image.edge)
    total = len(corners(board))
    count = len(list(names))
    problems = problem_words(reasons)
    if not edges:
        raise MeasurementError("; ".join([f"none of {count} images is usable ({board.words})", *problems]))
    all_sigmas = np.concatenate(sigmas)
    sigma = float(np.nanmedian(all_sigmas))
    edge = float(np.nanmedian(edges))
    quality = f"each to about {sigma:.2f} px; edges {edge:.1f} px wide"
    lines = [
        f"{len(edges)} of {count} images are usable ({board.words})",
        f"{np.mean(corner_counts):.1f} of {total} corners per image, {quality}",
    ]
    if detection.size[0]:
        all_pixels = np.concatenate(pixels)
        lines.append(coverage_words(all_pixels, detection.size))
    return [*lines, *detection.notes, *problems]
