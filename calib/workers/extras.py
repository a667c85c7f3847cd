"""Packages that are not installed with the core, by what they are for, and the line that installs each.

The core selects, fits, identifies, designs motions and exports. Viewer, camera, figures, PDF, collision shapes and the
reading of some files stand on packages of their own, the extras of ``pyproject.toml``.
"""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from typing import NamedTuple

from calib.errors import UsageError

LOG = logging.getLogger(__name__)


class Package(NamedTuple):
    """A package that an extra installs.

    Attributes:
        extra: name of the extra.
        purpose: what it is for, as a noun.
    """

    extra: str
    purpose: str


PACKAGES = {
    "cv2": Package("camera", "images and printed boards"),
    "rerun": Package("view", "the viewer"),
    "matplotlib": Package("plots", "figures"),
    "typst": Package("pdf", "the certificate as PDF"),
    "pinocchio": Package("meshes", "collision shapes of a URDF and exported robots read back"),
    "yourdfpy": Package("yourdfpy", "a second reading back of exported URDFs"),
    "cvxpy": Package("constraints", "constraints as CVXPY expressions"),
    "rosbags": Package("bags", "ROS bags"),
    "mujoco": Package("mujoco", "MJCF files as robots"),
    "pyarrow": Package("parquet", "LeRobot data sets and Parquet files"),
    "pandas": Package("pandas", "data frames"),
    "distributed": Package("cluster", "a Dask scheduler"),
    "starlette": Package("serve", "calib serve"),
}
"""Module -> the extra that installs it."""


@contextmanager
def needing(module: str, also: str = "") -> Iterator[None]:
    """Turn a failed import in the block into a message with the line that installs the package.

    Args:
        module: one of `PACKAGES`.
        also: what else the user can do.

    Raises:
        UsageError: a package of the extra is not installed.
    """
    try:
        yield
    except ImportError as error:
        raise UsageError(f"{lacking(module, error.name)}{also}") from error


def lacking(module: str, name: str | None = None) -> str:
    """Return the sentence that says what lacks a package, and the line that installs it.

    Args:
        module: one of `PACKAGES`.
        name: the module that is not installed; None: `module` itself.
    """
    extra, purpose = PACKAGES[module]
    return f"{name or module}, for {purpose}, is not installed: pip install 'armature-calib[{extra}]'"


def installed(module: str) -> bool:
    """Return whether a module of `PACKAGES` is installed, by its presence alone."""
    try:
        return find_spec(module) is not None
    except ModuleNotFoundError:
        return False


def available(module: str) -> bool:
    """Return whether a module of `PACKAGES` is installed; if not, log what is left out, which commands print once."""
    if installed(module):
        return True
    LOG.warning("warning: left out: %s", lacking(module))
    return False
