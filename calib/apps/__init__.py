"""Applications: commands beyond the calibration procedure.

Each application is a package that can be deleted without changes elsewhere. It may import only the modules of
`calib.toolkit` that `PUBLIC` lists, and other applications only where the import layers in ``pyproject.toml``
(``[tool.importlinter]``) allow it.
"""

# what applications may import: the names of `import calib`, these modules, and what stands in these packages
PUBLIC = (
    "calib.arguments",
    "calib.bug_reports",
    "calib.cli",
    "calib.config",
    "calib.config_types",
    "calib.errors",
    "calib.extensions",
    "calib.files",
    "calib.folders",
    "calib.records",
    "calib.result_kinds",
    "calib.toolkit",
    "calib.transforms",
    "calib.units",
    "calib.workers",
)
