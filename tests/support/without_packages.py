"""Runs calib's commands as if packages were not installed: python without_packages.py cv2,rerun fit robot.urdf …"""

import sys
from importlib.machinery import ModuleSpec
from types import ModuleType


class Absent:
    """Finder that knows of no module of the packages."""

    def __init__(self, packages: set[str]):
        self.packages = packages

    def find_spec(self, name: str, path: object = None, target: ModuleType | None = None) -> ModuleSpec | None:
        if name.partition(".")[0] in self.packages:
            raise ModuleNotFoundError(f"No module named '{name}'", name=name)
        return None


if __name__ == "__main__":
    sys.meta_path.insert(0, Absent(set(sys.argv[1].split(","))))
    sys.argv = ["calib", *sys.argv[2:]]
    from calib.cli import main

    main()
