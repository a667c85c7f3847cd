"""Claims, on rendered images: corners are found to a few hundredths of a pixel, and useless images are said to be."""

import re
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.data.images.board import Board, corners
from calib.data.images.detection import detect, detected
from calib.data.images.images import decode, read_image
from calib.data.images.lens import Lens
from calib.data.images.pixels import Detection
from calib.errors import MeasurementError
from calib.simulation.rendered_camera import Imaging, render
from calib.transforms import pose

LENS = Lens("pinhole", np.array([620.0, 622.0, 320.0, 238.0, -0.2, 0.08, 5e-4, -3e-4, 0.0]), (640, 480))
BOARDS = {
    "charuco": Board("charuco", 7, 5, 0.03, 0.022, "4x4_50"),
    "apriltag": Board("apriltag", 4, 3, 0.035, 0.012, "apriltag_36h11"),
    "chessboard": Board("chessboard", 8, 5, 0.025),
}


def placed(x=25.0, y=-20.0, z=10.0, distance=0.35, right=0.0) -> np.ndarray:
    turn = Rotation.from_euler("xyz", [x, y, z], degrees=True).as_matrix()
    return pose(turn, np.array([right, 0.0, distance]) - turn @ [0.105, 0.07, 0.0])


@cache
def image(kind: str, *angles: float, imaging: Imaging | None = None) -> np.ndarray:
    return render(BOARDS[kind], LENS, placed(*angles), imaging, 1)


def errors(found: Detection, kind: str, *angles: float) -> np.ndarray:
    where = placed(*angles)
    return (found.pixel - LENS.project(corners(BOARDS[kind]) @ where[:3, :3].T + where[:3, 3]))[found.seen]


@pytest.mark.parametrize("angles", [(), (10.0, 20.0, 170.0)])
@pytest.mark.parametrize("kind, most", [("charuco", 0.05), ("chessboard", 0.05), ("apriltag", 0.4)])
def test_corners_are_found_where_they_are(kind, most, angles):
    """Upright and nearly upside down: perspective, distortion, defocus, noise, uneven light."""
    found = detect(image(kind, *angles), BOARDS[kind])
    assert not found.problem and found.seen.all()
    wrong = errors(found, kind, *angles)
    assert np.sqrt(np.mean(wrong**2)) < most
    assert np.abs(wrong.mean(axis=0)).max() < 0.3 * most
    assert 0.3 < np.sqrt(np.mean(wrong**2)) / np.nanmedian(found.sigma) < 3.0


def test_sigmas_grow_with_noise():
    quiet, loud = (detect(image("charuco", imaging=Imaging(read=read)), BOARDS["charuco"]) for read in (1.0, 8.0))
    assert np.nanmedian(loud.sigma) > 1.5 * np.nanmedian(quiet.sigma)
    assert np.sqrt(np.mean(errors(loud, "charuco") ** 2)) < 3.0 * np.nanmedian(loud.sigma)


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda im: im[:, ::-1].copy(), "mirrored"),
        (lambda im: im // 12, "too dark"),
        (lambda im: np.full_like(im, 255), "over-exposed"),
        (lambda im: np.full_like(im, 90), "no board found"),
        (lambda im: cv2.GaussianBlur(im, (0, 0), 9), r"sharpest edges are \d+ px wide: out of focus"),
    ],
)
def test_why_an_image_is_of_no_use(change, words):
    found = detect(change(image("charuco")), BOARDS["charuco"])
    assert re.search(words, found.problem)
    assert not found.seen.any()


@pytest.mark.slow
def test_another_dictionary_is_named():
    found = detect(image("charuco"), replace(BOARDS["charuco"], dictionary="6x6_50"))
    assert "no markers of 6x6_50, but some of 4x4_100" in found.problem


def test_other_layout_is_told_from_no_board():
    """Another layout is told from no board."""
    found = detect(image("charuco"), replace(BOARDS["charuco"], columns=6))
    assert re.search(r"\d+ markers of 4x4_50 are seen, but not where board.toml has them", found.problem)


def test_two_exchanged_markers_are_named():
    """Of a self-made board, the two markers that lie in each other's places are named, bright as the picture may be."""
    board = BOARDS["charuco"]
    old_board = cv2.aruco.CharucoBoard((7, 5), 0.03, 0.022, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
    picture = cv2.copyMakeBorder(old_board.generateImage((560, 400)), 40, 40, 40, 40, cv2.BORDER_CONSTANT, value=255)
    assert detect(picture, board).problem == ""
    pixels, ids, _ = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)).detectMarkers(
        picture
    )
    regions = {}
    for marker, corner_pixels in zip(ids.ravel().tolist(), pixels):
        left, top = np.round(corner_pixels[0].min(axis=0)).astype(int)
        regions[marker] = np.s_[top - 2 : top + 64, left - 2 : left + 64]
    exchanged = picture.copy()
    exchanged[regions[4]] = picture[regions[11]]
    exchanged[regions[11]] = picture[regions[4]]
    assert "markers 4 and 11 are exchanged on the board" in detect(exchanged, board).problem


@pytest.mark.slow
def test_motion_is_told_from_defocus():
    way = np.array([placed(right=shift) for shift in np.linspace(-0.0025, 0.0025, 7)])
    found = detect(render(BOARDS["chessboard"], LENS, way, None, 1), BOARDS["chessboard"])
    assert "the arm was still moving" in found.problem


def test_half_visible_board_gives_its_part():
    """A board half out of view gives what is seen."""
    found = detect(image("charuco", 25.0, -20.0, 10.0, 0.35, 0.13), BOARDS["charuco"])
    assert not found.problem and 8 <= found.seen.sum() < 24
    assert np.abs(errors(found, "charuco", 25.0, -20.0, 10.0, 0.35, 0.13)).max() < 0.3


def test_bits_and_orientation_change_nothing(tmp_path):
    """16 bits, colour, and a JPEG that says it is turned: the same corners."""
    grey = image("charuco")
    want = detect(grey, BOARDS["charuco"]).pixel
    cv2.imwrite(str(tmp_path / "deep.png"), grey.astype(np.uint16) * 200)
    cv2.imwrite(str(tmp_path / "colour.png"), cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR))
    jpeg = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()
    exif = (
        b"Exif\x00\x00MM\x00*\x00\x00\x00\x08\x00\x01\x01\x12\x00\x03\x00\x00\x00\x01\x00\x06\x00\x00\x00\x00\x00\x00"
    )
    (tmp_path / "turned.jpg").write_bytes(jpeg[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + jpeg[2:])
    for name, most in (("deep.png", 0.05), ("colour.png", 1e-3), ("turned.jpg", 0.05)):
        read = read_image(tmp_path / name)
        assert read.shape == (480, 640) and read.dtype == np.uint8
        assert np.nanmax(np.abs(detect(read, BOARDS["charuco"]).pixel - want)) < most


@pytest.mark.parametrize("content, words", [(b"", "empty"), (b"\x89PNG\r\n\x1a\nxxxx", "image format is unknown")])
def test_a_corrupt_file_is_refused(content, words, tmp_path):
    (tmp_path / "bad.png").write_bytes(content)
    with pytest.raises(MeasurementError, match=words):
        read_image(tmp_path / "bad.png")
    with pytest.raises(ValueError, match=words):
        decode(content)


OLD = Board("charuco", 8, 6, 0.026, 0.018, "4x4_50", legacy=True)
SEEN = {"old": OLD, "new": Board("charuco", 9, 7, 0.022, 0.015, "4x4_50"), "tags": BOARDS["apriltag"]}
SEEN["chessboard"] = Board("chessboard", 10, 7, 0.02)


def reasons(kind: str, **stated: object) -> tuple[str, str]:
    """Return the reason why an image of a board is unusable with another board stated, and the notes."""
    picture = render(SEEN[kind], LENS, placed(10.0, -10.0, 5.0, 0.4), None, 1)
    found = detected([("1.png", picture)], replace(SEEN[kind], **stated))
    return found.images["1.png"].problem, " ".join(found.notes)


def test_the_old_charuco_pattern_is_read_and_named():
    """A ChArUco board of OpenCV before 4.6 is read with its pattern, and the line for board.toml is said."""
    problem, notes = reasons("old", legacy=False)
    assert not problem and "OpenCV before 4.6" in notes and "legacy = true in board.toml" in notes
    assert not "".join(reasons("old"))
    old_board = cv2.aruco.CharucoBoard((8, 6), 0.026, 0.018, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
    old_board.setLegacyPattern(True)
    picture = cv2.copyMakeBorder(old_board.generateImage((640, 480)), 40, 40, 40, 40, cv2.BORDER_CONSTANT, value=255)
    assert np.array_equal(detect(picture, OLD).seen, np.ones(35, dtype=bool))


@pytest.mark.parametrize(
    ("kind", "stated", "words"),
    [
        ("new", {"columns": 7, "rows": 9}, "columns and rows are exchanged; they fit columns = 9, rows = 7"),
        ("new", {"columns": 8, "rows": 6}, "squares are counted, not inner corners; they fit columns = 9, rows = 7"),
        pytest.param("new", {"columns": 6, "rows": 8}, "exchanged, and squares are counted", marks=pytest.mark.slow),
        pytest.param("new", {"columns": 12, "rows": 5}, "they fit a board of 9 columns", marks=pytest.mark.slow),
        ("old", {"columns": 7, "rows": 5, "legacy": False}, "they fit columns = 8, rows = 6, legacy = true"),
        ("tags", {"columns": 3, "rows": 4}, "columns and rows are exchanged; they fit columns = 4, rows = 3"),
        pytest.param(
            "chessboard", {"columns": 9, "rows": 6}, "a chessboard of 10 x 7 squares is seen", marks=pytest.mark.slow
        ),
    ],
)
def test_a_board_stated_wrongly_is_named(kind, stated, words):
    """Exchanged or inner counts in board.toml are named by where the markers are."""
    assert words in reasons(kind, **stated)[0]
