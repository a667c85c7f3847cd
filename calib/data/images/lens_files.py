"""Reading a lens from the files in which programs write it.

==================  ===================================================================================================
ROS camera_info     ``image_width``, ``camera_matrix: {data: [9]}``, ``distortion_model``,
                    ``distortion_coefficients: {data: […]}``; the message's flat keys ``width height K D`` too
OpenCV              FileStorage (YAML, XML, JSON): ``camera_matrix`` (``cameraMatrix``, ``K``, ``mtx``) and
                    ``distortion_coefficients`` (``dist_coeffs``, ``distCoeffs``, ``D``); ``fisheye_model: 1``
kalibr              camchain: ``cam0: {camera_model, intrinsics, distortion_model, distortion_coeffs, resolution}``
RealSense, Zivid    ``width height fx fy ppx ppy model coeffs``; ``CameraMatrix: {FX, …}``, ``Distortion: {K1, …}``
==================  ===================================================================================================

Where a file does not say the size of its images, it is that of the images beside it. RealSense's inverse_brown_conrady
is read as plumb_bob: librealsense projects by the same formula, up to products of radial and tangential terms.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from calib.config_types import shown
from calib.data.images.lens import NAMES, Lens
from calib.data.trees import as_numbers, by_lower_case, read_tree
from calib.errors import CalibError, MeasurementError, refused_as, suggestion

# Distortion models of programs, and the models of this toolkit.
MODELS = {
    **dict.fromkeys(("plumb_bob", "rational_polynomial"), "pinhole"),
    **dict.fromkeys(("radtan", "radial-tangential", "pinhole", "brown_conrady", "opencv", "none"), "pinhole"),
    **dict.fromkeys(("inverse_brown_conrady", "modified_brown_conrady"), "pinhole"),
    **dict.fromkeys(("equidistant", "equi", "fisheye", "kannala_brandt4", "kannala_brandt"), "fisheye"),
}
# Numbers of coefficients that the models may have, the usual number last; models that are not here have 4.
COEFFICIENTS = {"plumb_bob": (0, 4, 5), "rational_polynomial": (8,)}
# Numbers that a pinhole of another name may have; those behind the eighth (thin prism, tilt) have to be 0.
PINHOLE_COUNTS = (0, 4, 5, 8, 12, 14)
# Numbers of values of a lens's distortion after which further ones are 0.
PLUMB_BOB, RATIONAL = 5, 8
MATRIX_KEYS = ("camera_matrix", "cameramatrix", "k", "intrinsic_matrix", "intrinsicmatrix", "mtx", "m1", "intrinsic")
FOCAL_KEYS = (("fx", "fy", "cx", "cy"), ("fx", "fy", "ppx", "ppy"), ("fu", "fv", "cu", "cv"))
DISTORTION_KEYS = (
    *("distortion_coefficients", "distortion_coeffs", "dist_coeffs", "dist_coeff", "distcoeffs", "distcoeff", "d"),
    *("distortioncoefficients", "distortion", "dist", "coeffs", "d1", "distortion_parameters"),
)
MODEL_KEYS = ("distortion_model", "model", "camera_model")
WIDTH_KEYS = ("image_width", "width", "imagewidth")
HEIGHT_KEYS = ("image_height", "height", "imageheight")
SIZE_KEYS = ("resolution", "image_size", "imagesize", "size")
# Largest plausible number of pixels of an image's side.
MAX_SIDE = 100_000

Node = Mapping[str, object]


def read_lens(path: str | Path, size: tuple[int, int] = (0, 0)) -> Lens:
    """Return the lens in a file of ROS, OpenCV, kalibr, RealSense or Zivid.

    Args:
        path: the file.
        size: width and height of the images [px], for files that do not state it; 0, 0: unknown.

    Raises:
        MeasurementError: for a key that is missing or invalid, named in the message.
    """
    path = Path(path)
    cameras = list(_cameras(read_tree(path)))
    if not cameras:
        raise MeasurementError(
            "has no lens: expected image_width, camera_matrix, distortion_coefficients (ROS, OpenCV), intrinsics "
            "(kalibr), or fx, fy, cx, cy",
            path,
        )
    if len(cameras) > 1:
        names = ", ".join(dict(cameras))
        raise MeasurementError(f"has {len(cameras)} lenses ({names}): leave that of these images", path)
    ((_, table),) = cameras
    intrinsics = _intrinsics(table, path)
    size = _size(table, size, path)
    model, coefficients = _distortion(table, path)
    with refused_as(MeasurementError, CalibError, "{}", path):
        return Lens(model, np.concatenate([intrinsics, coefficients]), size)


def _cameras(node: object, name: str = "") -> Iterator[tuple[str, Node]]:
    """Yield name and table of each camera in a tree: each table with a camera matrix or focal lengths."""
    if isinstance(node, Mapping):
        table = by_lower_case(node)
        if _has_focal_lengths(table):
            yield name, table
            return
        for key, value in node.items():
            yield from _cameras(value, str(key))
    elif isinstance(node, list):
        for value in node:
            yield from _cameras(value, name)


def _has_focal_lengths(table: Node) -> bool:
    """Return whether a table (keys in lower case) has a camera matrix, or focal lengths."""
    if "intrinsics" in table and as_numbers(table["intrinsics"]) is not None:
        return True
    return bool(_key(table, MATRIX_KEYS) or _focal_keys(table))


def _key(table: Node, keys: tuple[str, ...]) -> str:
    """Return the first of some keys that a table has; empty if it has none."""
    for key in keys:
        if key in table:
            return key
    return ""


def _focal_keys(table: Node) -> tuple[str, ...]:
    """Return the names under which a table has focal lengths and principal point; () if it has none."""
    for keys in FOCAL_KEYS:
        if set(keys) <= set(table):
            return keys
    return ()


def _intrinsics(table: Node, path: Path) -> np.ndarray:
    """Return fx, fy, cx, cy [px] of a camera's table; raise MeasurementError for others."""
    focal_keys = _focal_keys(table)
    if focal_keys:
        return _numbers(list(map(table.get, focal_keys)), "fx, fy, cx, cy", path)
    key = _key(table, (*MATRIX_KEYS, "intrinsics"))
    value = table[key]
    if isinstance(value, Mapping):
        # Zivid: a matrix by the names of its numbers
        by_name = by_lower_case(value)
        if _focal_keys(by_name):
            return _intrinsics(by_name, path)
    matrix = _numbers(value, key, path)
    if len(matrix) == 4 and key == "intrinsics":
        return matrix
    if len(matrix) != 9 or matrix[8] != 1.0 or abs(matrix[1]) > 1e-6 * abs(matrix[0]):
        raise MeasurementError(f"{key}: expected [fx 0 cx 0 fy cy 0 0 1], found {matrix.tolist()}", path)
    return matrix[[0, 4, 2, 5]]


def _size(table: Node, size: tuple[int, int], path: Path) -> tuple[int, int]:
    """Return width and height of the images [px] that a table states; else `size`."""
    for key in SIZE_KEYS:
        numbers = as_numbers(table.get(key))
        if numbers is not None and numbers.size == 2:
            width, height = numbers.astype(int).tolist()
            return width, height
    if not _key(table, (*WIDTH_KEYS, *HEIGHT_KEYS)) and size[0]:
        return size
    return _pixel_count(table, WIDTH_KEYS, path), _pixel_count(table, HEIGHT_KEYS, path)


def _distortion(table: Node, path: Path) -> tuple[str, np.ndarray]:
    """Return the model of a lens and its distortion coefficients, as many as the model has here."""
    name = _model_name(table, path)
    coefficients = _coefficients(table, name, path)
    count = len(coefficients)
    allowed = COEFFICIENTS.get(name, (4,))
    if MODELS.get(name, "pinhole") == "pinhole" and name not in COEFFICIENTS:
        allowed = PINHOLE_COUNTS
    if count not in allowed:
        message = f"distortion_model {name} has {allowed[-1]} coefficients, found {count}"
        raise MeasurementError(message, path)
    if MODELS.get(name) == "fisheye":
        return "fisheye", coefficients
    if np.any(coefficients[RATIONAL:]):
        raise MeasurementError(
            f"{count} distortion coefficients, of which those behind the eighth (thin prism, tilt) are not 0: "
            "calibrate the lens without them",
            path,
        )
    length = PLUMB_BOB if count <= PLUMB_BOB else RATIONAL
    padding = np.zeros(max(length - count, 0))
    return "pinhole", np.concatenate([coefficients[:length], padding])


def _model_name(table: Node, path: Path) -> str:
    """Return the name of a table's distortion model, in lower case; plumb_bob where it has none."""
    if table.get("fisheye_model"):
        return "fisheye"
    for key in MODEL_KEYS:
        value = table.get(key)
        if value is None or value == "":
            continue
        name = str(value).lower().removeprefix("distortion.").replace(" ", "_")
        if key == "camera_model" and name == "pinhole":
            continue
        if name not in MODELS:
            message = f"{key} '{name}'{suggestion(name, MODELS)} is unknown; expected one of {', '.join(MODELS)}"
            raise MeasurementError(message, path)
        return name
    return "opencv"


def _coefficients(table: Node, name: str, path: Path) -> np.ndarray:
    """Return the distortion coefficients of a table, in the order of the lens's values."""
    key = _key(table, DISTORTION_KEYS)
    if not key:
        if name == "none":
            return np.zeros(0)
        return _numbers(None, DISTORTION_KEYS[0], path)
    value = table[key]
    if isinstance(value, Mapping) and "data" not in value:
        by_name = by_lower_case(value)
        numbers = list(map(by_name.get, NAMES[MODELS[name]][4:]))
        while numbers and numbers[-1] is None:
            numbers.pop()
        return _numbers(numbers, key, path)
    if isinstance(value, list) and not value:
        return np.zeros(0)
    return _numbers(value, key, path)


def _pixel_count(table: Node, keys: tuple[str, ...], path: Path) -> int:
    """Return the number of pixels that a table states under one of the keys; raise MeasurementError for others."""
    value = table.get(_key(table, keys))
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if not isinstance(value, int) or not 0 < value < MAX_SIDE:
        raise MeasurementError(f"{keys[0]}: expected a number of pixels, found {shown(value)}", path)
    return value


def _numbers(value: object, key: str, path: Path) -> np.ndarray:
    """Return the numbers (N,) of a key's value; raise MeasurementError for others."""
    if isinstance(value, Mapping):
        value = value.get("data")
    if isinstance(value, list) and not value:
        return np.zeros(0)
    numbers = as_numbers(value)
    if numbers is None or not np.isfinite(numbers).all():
        raise MeasurementError(f"{key}: expected data: [numbers], found {shown(value)}", path)
    return numbers.ravel()
