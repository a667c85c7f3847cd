"""Output of `calib board` and `calib images`: boards to print, and a check of their images."""

from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path

import numpy as np

from calib import files
from calib.data.poses import BOARD, JOINTS
from calib.errors import CalibError, MeasurementError, UsageError, refused_as, require
from calib.rooms.camera import board as boards
from calib.rooms.camera.board import KINDS, Board
from calib.rooms.camera.image_findings import coverage_words
from calib.rooms.camera.pictures.corner_file import Found
from calib.rooms.camera.pictures.image_folders import find_corners, joint_table, problem_words, read_own_board

Show = Callable[[str], None]
USUAL = {"charuco": ("5x5_100", 0.7, 9), "chessboard": ("5x5_100", 0.7, 10), "apriltag": ("apriltag_36h11", 0.3, 9)}


def make(
    out: Path, kind: str, columns: int | None, rows: int, square: float, marker: float | None, words: str | None,
    paper: str | None, overwrite: bool = False,
) -> list[str]:  # fmt: skip
    """Write ``board.toml``, ``board.pdf`` and ``board.svg``; return printing instructions.

    Args:
        out: folder.
        kind, columns, rows, words, paper: see `calib.rooms.camera.board`; a dictionary, and the paper's name. None: the
            usual ones.
        square, marker: [mm].
        overwrite: replace another board that is there, whose squares somebody may have measured.

    Raises:
        UsageError: for a board that cannot be, or does not fit onto its paper, and for another that is there already.
    """
    from calib.rooms.camera.pictures import board_print
    from calib.rooms.camera.pictures.detection import MIN_CORNERS

    require(kind in KINDS, f"--kind {kind}: expected one of {', '.join(KINDS)}", UsageError)
    if paper is not None and paper.lower() not in board_print.PAPERS:
        raise UsageError(f"--paper {paper}: expected one of {', '.join(board_print.PAPERS)}")
    min_square = 1.0  # side of a square [mm]
    if square < min_square:
        raise UsageError(f"--square {square:g}: a square of {square:g} mm cannot be printed; --square counts in mm")
    usual, share, across = USUAL[kind]
    with refused_as(UsageError, ValueError, "impossible board: {}"):
        side, between = square / 1e3, (share * square if marker is None else marker) / 1e3
        made = Board(kind, columns or across, rows, side, between, words or usual).checked()
        if (count := len(boards.corners(made))) < MIN_CORNERS:
            raise UsageError(f"a {made.words} has {count} corners, an image needs {MIN_CORNERS}: take more squares")
        size = board_print.page_size(made, (paper or "").lower())
    there = out / BOARD
    if not overwrite and there.exists() and not _as_printed(out):
        raise UsageError(
            f"{there} was changed after printing (measured squares?), or is another board's; nothing was written. "
            "Take another folder (--out), or give --overwrite"
        )
    files.write(out / "board.pdf", board_print.pdf(made, size))
    files.write(out / "board.svg", board_print.svg(made, size))
    boards.write_board(made, out / BOARD)
    wide, high = (round(1e3 * length) for length in size)
    return [
        f"{made.words}, {len(boards.corners(made))} corners, on a page of {wide} x {high} mm: {out / 'board.pdf'}",
        "print it at 100 % (not fitted to the page), check the ruler, glue it onto glass or aluminium; then measure "
        f"several squares together and put the size of one into {out / BOARD}: the robot's lengths get their "
        "scale from it",
    ]


def _as_printed(out: Path) -> bool:
    """Return whether a folder's ``board.toml`` still describes its ``board.svg``, as `make` wrote both."""
    from calib.rooms.camera.pictures import board_print

    try:
        found, drawn = boards.read_board(out), (out / "board.svg").read_bytes()
        sizes = []
        for paper in ("", *board_print.PAPERS):
            with suppress(ValueError):  # a paper that it does not fit onto
                sizes.append(board_print.page_size(found, paper))
        drawings = (board_print.svg(found, size) for size in dict.fromkeys(sizes))
        return any((one.encode() if isinstance(one, str) else one) == drawn for one in drawings)
    except (OSError, ValueError, CalibError):
        return False


def look(folder: Path, show: Show) -> list[str]:
    """Return sentences on the board detection in the images of a folder."""
    board = read_own_board(folder)
    names = joint_table(folder).texts("image") if (folder / JOINTS).exists() else _images(folder)
    found = find_corners(folder, board, names, lambda done, total, name: show(f"{done} of {total}: {name}"))
    return _summary(found, board, names)


def _images(folder: Path) -> list[str]:
    from calib.rooms.camera.pictures.images import SUFFIXES

    names = sorted(path.name for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)
    require(names, f"{folder}: there is neither a {JOINTS} nor an image ({', '.join(SUFFIXES)})", UsageError)
    return names


def _summary(found: Found, board: Board, names: Iterable[str]) -> list[str]:
    """Return sentences on detected corners: how many images are usable, why others are not, what they cover.

    Raises:
        MeasurementError: where none is of use, with the reasons.
    """
    kept = [one for one in found.images.values() if not one.problem]
    total = len(boards.corners(board))
    problems = problem_words({name: one.problem for name, one in found.images.items()})
    if not kept:
        raise MeasurementError("; ".join([f"none of {len(list(names))} images is usable ({board.words})", *problems]))
    seen = np.array([one.seen.sum() for one in kept])
    sigma = float(np.nanmedian(np.concatenate([one.sigma[one.seen] for one in kept])))
    edge = float(np.nanmedian([one.edge for one in kept]))
    lines = [
        f"{len(kept)} of {len(list(names))} images are of use ({board.words})",
        f"{seen.mean():.1f} of {total} corners per image, each to about {sigma:.2f} px; edges {edge:.1f} px wide",
    ]
    if found.size[0]:
        lines.append(coverage_words(np.concatenate([one.pixel[one.seen] for one in kept]), found.size))
    return [*lines, *problems]


def from_bag(
    bag: Path, board: Path, out: Path, image_topic: str | None, joint_topic: str | None, show: Show
) -> list[str]:
    """Write the corners and joint values of a bag's images as a folder; return sentences on the result."""
    from calib.rooms.camera.pictures.image_bags import read_image_bag, write_image_folder

    made = boards.read_board(board)
    found = read_image_bag(bag, made, image_topic or "", joint_topic or "", lambda k, name: show(f"image {k}: {name}"))
    write_image_folder(found, made, out)
    lines = _summary(found.corners, made, found.names)
    return [*lines, *found.notes, f"written to {out}; calib fit ROBOT {out} --out FOLDER fits it"]
