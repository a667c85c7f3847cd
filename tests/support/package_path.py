"""Print where the process of a script finds the package."""

import calib

print(calib.__file__)
