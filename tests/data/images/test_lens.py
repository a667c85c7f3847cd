"""Claims: projections are OpenCV's; their derivatives are exact; rays are their inverse."""

import cv2
import numpy as np
import pytest
from differences import check

from calib.data.images.lens import Lens, rays, write_lens
from calib.data.images.lens_files import read_lens
from calib.errors import CalibError, MeasurementError

SIZE = (800, 600)
BASE = [780.0, 782.0, 400.0, 298.0]
LENSES = {
    "plain": Lens("pinhole", np.array([*BASE, -0.2, 0.08, 5e-4, -3e-4, 0.02]), SIZE),
    "rational": Lens("pinhole", np.array([*BASE, -0.2, 0.08, 5e-4, -3e-4, 0.02, 0.03, 0.01, 0.004]), SIZE),
    "fisheye": Lens("fisheye", np.array([500.0, 505.0, 400.0, 298.0, 0.05, -0.02, 0.01, 0.003]), SIZE),
}


def points(count: int = 25, spread: float = 0.3) -> np.ndarray:
    return spread * np.random.default_rng(0).normal(size=(count, 3)) + [0.0, 0.0, 1.5]


@pytest.mark.parametrize("name", LENSES)
def test_pixels_are_opencvs(name):
    lens, place = LENSES[name], points()
    matrix = np.array([[lens.values[0], 0, lens.values[2]], [0, lens.values[1], lens.values[3]], [0, 0, 1.0]])
    if lens.model == "fisheye":
        theirs = cv2.fisheye.projectPoints(place[:, None], np.zeros(3), np.zeros(3), matrix, lens.values[4:])[0]
    else:
        theirs = cv2.projectPoints(place, np.zeros(3), np.zeros(3), matrix, lens.values[4:])[0]
    assert lens.project(place) == pytest.approx(theirs.reshape(-1, 2), abs=1e-9)


@pytest.mark.parametrize("name", LENSES)
def test_derivatives_and_the_inverse(name):
    lens, place = LENSES[name], points()
    pixel, by_point, by_value = lens.project_with_slopes(place)
    for k in range(0, 25, 6):
        check(lambda x: lens.project(x[None])[0], by_point[k], place[k])
        check(lambda v: lens.with_values(v).project(place[k : k + 1])[0], by_value[k], lens.values, tolerance=1e-6)  # noqa: B023
    assert rays(lens, pixel) == pytest.approx(place[:, :2] / place[:, 2:], abs=1e-12)


def test_folded_distortion_is_out_of_sight():
    """A point where the distortion turns back is out of sight."""
    # r (1 - 0.4 r²) falls again beyond r = 0.91
    strong = Lens("pinhole", np.array([400.0, 400.0, *BASE[2:], -0.4, 0, 0, 0, 0]), SIZE)
    inside, beyond = np.array([[0.3, 0.0, 1.0]]), np.array([[1.5, 0.0, 1.0]])
    assert np.all(strong.project(beyond) < SIZE)
    assert strong.in_sight(np.concatenate([inside, beyond, -inside])).tolist() == [True, False, False]


@pytest.mark.parametrize("name", LENSES)
def test_lens_is_written_as_ros_reads_it(name, tmp_path):
    """A lens is written as ROS reads it, and read back."""
    path = write_lens(LENSES[name], tmp_path / "camera.yaml")
    again = read_lens(path)
    assert np.array_equal(again.values, LENSES[name].values) and again.size == SIZE
    assert again.model == LENSES[name].model


@pytest.mark.parametrize(
    "change, words",
    [
        (("distortion_model: plumb_bob", "distortion_model: plum_bob"), "distortion_model 'plum_bob' \\(did you mean"),
        (("image_width: 800", "image_width: wide"), "image_width: expected a number of pixels, found 'wide'"),
        (("  data: [780.0", "  data: [.nan"), "camera_matrix: expected data"),
        (("  data: [780.0, 0.0", "  data: [780.0, 5.0"), r"expected \[fx 0 cx"),
        (("camera_matrix", "matrix"), "has no lens: expected image_width, camera_matrix"),
        (("image_width: 800", "image_width: 800: 1"), "cannot be read as YAML"),
    ],
)
def test_impossible_camera_is_refused_by_key(change, words, tmp_path):
    """An impossible camera file is refused by its key."""
    path = write_lens(LENSES["plain"], tmp_path / "camera.yaml")
    path.write_text(path.read_text().replace(*change))
    with pytest.raises(MeasurementError, match=words):
        read_lens(path)


def test_lens_without_focal_length_refused():
    """A lens without focal length is refused."""
    with pytest.raises(CalibError, match="focal lengths -1, 1 px"):
        Lens("pinhole", np.array([-1.0, 1.0, 0, 0, 0, 0, 0, 0, 0]), SIZE)


OPENCV = """%YAML:1.0
---
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 780., 0., 400., 0., 782., 298., 0., 0., 1. ]
dist_coeffs: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ -0.2, 0.08, 0.0005, -0.0003, 0.02 ]
"""
OPENCV_XML = """<?xml version="1.0"?>
<opencv_storage>
<image_width>800</image_width><image_height>600</image_height>
<cameraMatrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt>
  <data>780. 0. 400. 0. 782. 298. 0. 0. 1.</data></cameraMatrix>
<distCoeffs type_id="opencv-matrix"><rows>5</rows><cols>1</cols><dt>d</dt>
  <data>-0.2 0.08 0.0005 -0.0003 0.02</data></distCoeffs>
</opencv_storage>
"""
KALIBR = """cam0:
  camera_model: pinhole
  distortion_coeffs: [-0.2, 0.08, 0.0005, -0.0003]
  distortion_model: radtan
  intrinsics: [780.0, 782.0, 400.0, 298.0]
  resolution: [800, 600]
"""
REALSENSE = (
    '{"width": 800, "height": 600, "fx": 780.0, "fy": 782.0, "ppx": 400.0, "ppy": 298.0, '
    '"model": "distortion.inverse_brown_conrady", "coeffs": [-0.2, 0.08, 0.0005, -0.0003, 0.02]}'
)
ZIVID = """CameraIntrinsics:
  CameraMatrix: {CX: 400.0, CY: 298.0, FX: 780.0, FY: 782.0}
  Distortion: {K1: -0.2, K2: 0.08, K3: 0.02, P1: 0.0005, P2: -0.0003}
"""


@pytest.mark.parametrize(
    ("text", "k3"), [(OPENCV, 0.02), (OPENCV_XML, 0.02), (KALIBR, 0.0), (REALSENSE, 0.02), (ZIVID, 0.02)]
)
def test_lenses_of_other_programs(text, k3, tmp_path):
    """Files of OpenCV, kalibr, RealSense and Zivid give the lens; a missing size is that of the images."""
    path = tmp_path / "lens.yaml"
    path.write_text(text)
    lens = read_lens(path, SIZE)
    assert lens.values == pytest.approx([*BASE, -0.2, 0.08, 5e-4, -3e-4, k3]) and lens.size == SIZE


def test_fisheyes_and_odd_lenses(tmp_path):
    """Fisheye models are told by their names; several lenses, and unknown models, are refused by name."""
    path = tmp_path / "lens.yaml"
    path.write_text(KALIBR.replace("radtan", "equidistant"))
    assert read_lens(path).model == "fisheye"
    for text, words in (
        (KALIBR + KALIBR.replace("cam0", "cam1"), r"has 2 lenses \(cam0, cam1\)"),
        (KALIBR.replace("radtan", "fov"), "distortion_model 'fov' is unknown"),
        (OPENCV, "image_width: expected a number of pixels"),
    ):
        path.write_text(text)
        with pytest.raises(MeasurementError, match=words):
            read_lens(path)
