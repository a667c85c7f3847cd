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

MEASURED = re.compile(r"(?<![\w.])\d+(?:\.\d+)?(?![\w.]*_)")  # a number, no part of a name
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
        path: of the folder.
        joints: as `calib.data.poses.pose_files.read_measurements`.
        options: see there; [camera] is about images.
        progress: called with (done, total, image).

    Raises:
        MeasurementError: where a file is missing or cannot be, or no three images are of use.
    """
    path, robot, options = Path(path), Joints.of(joints), options or FileOptions()
    board = read_own_board(path)
    table = joint_table(path)
    sheet = Sheet(table, options)
    q, columns = sheet.joints(robot.names)
    notes = list(plausible.check_joints(q, sheet, columns, robot))
    found = find_corners(path, board, table.texts("image"), progress)
    names = table.texts("image")
    rows, said = _usable(names, found, path)
    notes += said
    lens, known = _own_lens(path, found.size, options)
    detected = [found.images[names[row]] for row in rows]
    return Pixels(
        q[rows],
        columns,
        np.array([one.pixel for one in detected]),
        board,
        lens,
        mounting=options.camera.mounting.replace("auto", ""),
        sigma=np.array([one.sigma for one in detected]),
        names=tuple(names),
        size=found.size if found.size[0] else (lens.size if lens else (0, 0)),
        known=known,
        free=_free(options, known),
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
        MeasurementError: where there is none.
    """
    words = f"has no {BOARD}, which describes the board: copy the one that calib board wrote into it"
    require((path / BOARD).is_file(), words, MeasurementError, path)
    return read_board(path)


def joint_table(path: Path) -> Table:
    """Return the table of the folder's ``joints.csv``."""
    place = path / JOINTS
    words = f"has no {JOINTS}: a table of image, q1 [deg] ... is needed, one row per image with its joint values"
    require(place.is_file(), words, MeasurementError, path)
    table = read_table(place)
    names = table.texts("image")
    if twice := [name for name, count in Counter(names).items() if count > 1]:
        raise MeasurementError(f"'{twice[0]}' occurs {names.count(twice[0])} times", place, column="image")
    return table


def find_corners(path: Path, board: Board, names: Sequence[str], progress: Progress | None = None) -> Found:
    """Return the corners of a folder's images: from ``corners.csv`` where that is newer, else by looking at them.

    Args:
        path: of the folder.
        board: to look for.
        names: of the images.
        progress: called with (done, total, image).
    """
    stored = path / CORNERS
    images = [path / name for name in names if (path / name).is_file()]
    if stored.is_file():
        newest = max((each.stat().st_mtime for each in (*images, path / BOARD)), default=0.0)
        kept = read_corners(stored, board)
        if stored.stat().st_mtime >= newest and {each.name for each in images} <= set(kept.images):
            return kept
    if not images:
        missing = f"'{names[0]}' and the others" if len(names) > 1 else f"'{names[0]}'" if names else "images"
        raise MeasurementError(f"none of the images named in {JOINTS} exists ({missing})", path)
    from calib.data.images.detection import detected  # loads OpenCV: only where images are looked at

    found = detected(((each.name, each) for each in images), board, len(images), progress)
    with suppress(CalibError):  # a folder that cannot be written into is read all the same
        write_corners(stored, found)
    return found


def _usable(names: Sequence[str], found: Found, path: Path, min_images: int = 3) -> tuple[np.ndarray, list[str]]:
    """Return the table's rows whose images are usable, and sentences on the others.

    `min_images`: usable images below which a folder is refused.
    """
    missing = [name for name in names if name not in found.images]
    problems = {name: found.images[name].problem for name in names if name in found.images}
    rows = np.array([k for k, name in enumerate(names) if problems.get(name) == ""], dtype=int)
    notes = []
    if missing:
        notes.append(f"{len(missing)} of {len(names)} rows have no image: {listing(missing, 5)}")
    if extra := sorted(set(found.images) - set(names)):
        notes.append(f"{len(extra)} images have no row in {JOINTS}: {listing(extra, 5)}")
    notes += problem_words(problems)
    if len(rows) < min_images:
        why = "; ".join(notes) or "there are no more rows"
        raise MeasurementError(
            f"{counted(len(rows), 'usable image')}: a calibration takes 20 to 40 from all "
            f"around, at least {min_images} ({why})",
            path,
        )
    return rows, notes


def problem_words(problems: Mapping[str, str]) -> list[str]:
    """Return a sentence per reason why images are unusable, with image names and the range of its numbers."""
    reasons: dict[str, list[str]] = {}
    for name, problem in problems.items():
        if problem:
            reasons.setdefault(MEASURED.sub("#", problem), []).append(name)
    result = []
    for reason, own in reasons.items():
        for each in zip(*(MEASURED.findall(problems[name]) for name in own)):
            low, high = min(each, key=float), max(each, key=float)
            reason = reason.replace("#", low if low == high else f"{low} to {high}", 1)
        result.append(f"{len(own)} image{'s are' if len(own) > 1 else ' is'} not usable ({reason}): {listing(own, 5)}")
    return result


def _own_lens(path: Path, size: tuple[int, int], options: FileOptions) -> tuple[Lens | None, bool]:
    """Return the folder's lens and whether it was given; None if the lens must be estimated from the images."""
    place = path / LENS
    if not place.is_file():
        if options.camera.intrinsics == "given":
            raise MeasurementError(f"has no {LENS}, required by intrinsics = 'given'", path)
        return None, False
    lens = read_lens(place)
    if size[0] and lens.size != size:
        raise MeasurementError(
            f"is for images of {lens.size[0]} x {lens.size[1]} pixels, the images here have {size[0]} x {size[1]}",
            place,
        )
    return lens, True


def _free(options: FileOptions, known: bool) -> tuple[str, ...]:
    """Return the names of the lens and board parameters that the options ask to fit."""
    camera, result = options.camera, list[str]()
    if camera.intrinsics == "fit" or (camera.intrinsics == "auto" and not known):
        own = {"pinhole": ("k1", "k2", "p1", "p2"), "fisheye": ("k1", "k2", "k3", "k4")}[camera.model]
        result += ["fx", "fy", "cx", "cy", *own]
    if "scale" in camera.board:
        result.append("scale")
    if "bend" in camera.board:
        result += ["bend_xx", "bend_xy", "bend_yy"]
    return tuple(result)


def look(folder: Path, show: Callable[[str], None]) -> list[str]:
    """Return a summary of the corner detection in a folder of images, as sentences."""
    board = read_own_board(folder)
    names = joint_table(folder).texts("image") if (folder / JOINTS).exists() else _images(folder)
    found = find_corners(folder, board, names, lambda done, total, name: show(f"{done} of {total}: {name}"))
    return detection_summary(found, board, names)


def _images(folder: Path) -> list[str]:
    from calib.data.images.images import SUFFIXES

    names = sorted(path.name for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)
    require(names, f"{folder}: there is neither a {JOINTS} nor an image ({', '.join(SUFFIXES)})", UsageError)
    return names


def detection_summary(found: Found, board: Board, names: Iterable[str]) -> list[str]:
    """Return sentences on detected corners: how many images are usable, why others are not, what they cover.

    Raises:
        MeasurementError: where none is of use, with the reasons.
    """
    kept = [one for one in found.images.values() if not one.problem]
    total = len(corners(board))
    problems = problem_words({name: one.problem for name, one in found.images.items()})
    if not kept:
        raise MeasurementError("; ".join([f"none of {len(list(names))} images is usable ({board.words})", *problems]))
    seen = np.array([one.seen.sum() for one in kept])
    sigma = float(np.nanmedian(np.concatenate([one.sigma[one.seen] for one in kept])))
    edge = float(np.nanmedian([one.edge for one in kept]))
    lines = [
        f"{len(kept)} of {len(list(names))} images are usable ({board.words})",
        f"{seen.mean():.1f} of {total} corners per image, each to about {sigma:.2f} px; edges {edge:.1f} px wide",
    ]
    if found.size[0]:
        lines.append(coverage_words(np.concatenate([one.pixel[one.seen] for one in kept]), found.size))
    return [*lines, *problems]
