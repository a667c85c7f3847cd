"""Reading and writing a lens as ROS ``camera_info`` YAML (camera_calibration_parsers).

``image_width``, ``image_height``, ``camera_matrix: {data: [9]}``, ``distortion_model`` (``plumb_bob``,
``rational_polynomial``, ``equidistant``) and ``distortion_coefficients: {data: [...]}``; the flat keys of the message
(``width height K D``) are read, too.
"""

from pathlib import Path
from typing import Any

import numpy as np

from calib import files
from calib.config_types import shown
from calib.errors import CalibError, MeasurementError, refused_as, require, suggestion
from calib.rooms.camera.lens import Lens

LENS = "camera.yaml"
MODELS = {"plumb_bob": "pinhole", "rational_polynomial": "pinhole", "equidistant": "fisheye", "fisheye": "fisheye"}


def read_lens(path: str | Path) -> Lens:
    """Return the lens of a ``camera_info`` file.

    Raises:
        MeasurementError: naming the key that is missing or cannot be.
    """
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        found = YAML(typ="safe", pure=True).load(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, YAMLError) as error:
        raise MeasurementError(f"cannot be read as YAML ({str(error).splitlines()[0]})", path) from error
    if not isinstance(found, dict):
        raise MeasurementError("is not a camera_info file: expected image_width, camera_matrix, distortion_model", path)
    size = (_whole(found, ("image_width", "width"), path), _whole(found, ("image_height", "height"), path))
    matrix = _numbers(found, ("camera_matrix", "K", "k"), path)
    if len(matrix) != 9 or matrix[8] != 1.0 or abs(matrix[1]) > 1e-6 * abs(matrix[0]):
        raise MeasurementError(f"camera_matrix: expected [fx 0 cx 0 fy cy 0 0 1], found {matrix.tolist()}", path)
    bend = _numbers(found, ("distortion_coefficients", "D", "d"), path)
    name = str(found.get("distortion_model") or "plumb_bob").lower()
    words = f"distortion_model '{name}'{suggestion(name, MODELS)} is unknown; expected one of {', '.join(MODELS)}"
    require(name in MODELS, words, MeasurementError, path)
    allowed = {"plumb_bob": (0, 4, 5), "rational_polynomial": (8,)}.get(name, (4,))
    if len(bend) not in allowed:
        raise MeasurementError(f"distortion_model {name} has {allowed[-1]} coefficients, found {len(bend)}", path)
    full = np.concatenate([bend, np.zeros(5 - len(bend))]) if name == "plumb_bob" else bend
    with refused_as(MeasurementError, CalibError, "{}", path):
        return Lens(MODELS[name], np.concatenate([matrix[[0, 4, 2, 5]], full]), size)


def _whole(found: dict[str, Any], keys: tuple[str, ...], path: str | Path) -> int:
    value = next((found[key] for key in keys if key in found), None)
    if not isinstance(value, int) or not 0 < value < 100_000:
        raise MeasurementError(f"{keys[0]}: expected a number of pixels, found {shown(value)}", path)
    return value


def _numbers(found: dict[str, Any], keys: tuple[str, ...], path: str | Path) -> np.ndarray:
    value = next((found[key] for key in keys if key in found), None)
    value = value.get("data") if isinstance(value, dict) else value
    try:
        numbers = np.array(value, dtype=float).ravel()
    except (TypeError, ValueError, OverflowError):
        numbers = np.array([np.nan])
    if value is None or not np.isfinite(numbers).all():
        raise MeasurementError(f"{keys[0]}: expected data: [numbers], found {shown(value)}", path)
    return numbers


def write_lens(lens: Lens, path: str | Path, name: str = "camera") -> Path:
    """Write a lens as ``camera_info`` YAML."""
    fx, fy, cx, cy = (float(value) for value in lens.values[:4])
    model = "equidistant" if lens.model == "fisheye" else "plumb_bob" if len(lens.values) == 9 else None
    lines = [
        f"image_width: {lens.size[0]}",
        f"image_height: {lens.size[1]}",
        f"camera_name: {name}",
        _matrix("camera_matrix", 3, 3, [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]),
        f"distortion_model: {model or 'rational_polynomial'}",
        _matrix("distortion_coefficients", 1, len(lens.values) - 4, lens.values[4:].tolist()),
        _matrix("rectification_matrix", 3, 3, np.eye(3).ravel().tolist()),
        _matrix("projection_matrix", 3, 4, [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]),
    ]
    return files.write(path, "\n".join(lines) + "\n")


def _matrix(name: str, rows: int, columns: int, data: list[float]) -> str:
    return f"{name}:\n  rows: {rows}\n  cols: {columns}\n  data: [{', '.join(repr(value) for value in data)}]"
