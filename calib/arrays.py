"""Read-only arrays, and the check of shapes."""

from dataclasses import fields

import numpy as np
from numpy.typing import ArrayLike

from calib.errors import CalibError


def frozen(values: ArrayLike, dtype: type = float) -> np.ndarray:
    """Return a read-only, C-contiguous copy of `values`."""
    array = np.array(values, dtype=dtype, order="C")
    array.flags.writeable = False
    return array


class Frozen:
    """Base of dataclasses whose fields annotated ``np.ndarray`` become read-only copies (floats or booleans)."""

    def __post_init__(self) -> None:
        for one in fields(self):  # type: ignore[arg-type]
            if one.type in (np.ndarray, "np.ndarray"):
                value = np.asarray(getattr(self, one.name))
                object.__setattr__(self, one.name, frozen(value, bool if value.dtype == bool else float))


def shaped(values: ArrayLike, shape: tuple[int | None, ...], name: str) -> np.ndarray:
    """Return `values` as a finite float array of `shape` (None: any length).

    Raises:
        CalibError: with the expected and the found shape, or the index of the first value that is not finite.
    """
    array = np.asarray(values, dtype=float)
    if array.ndim != len(shape) or any(want is not None and want != got for want, got in zip(shape, array.shape)):
        expected = "(" + ", ".join("any" if want is None else str(want) for want in shape) + ")"
        raise CalibError(f"{name}: expected an array of shape {expected}, found {array.shape}")
    if not np.isfinite(array).all():
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise CalibError(f"{name}: value at index {where} is not finite ({array[where]})")
    return array
