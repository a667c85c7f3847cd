"""``python -m calib.cli``."""

from calib.cli import main

main()
