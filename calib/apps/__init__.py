"""Applications: what commands offer beside the procedure, each a package that can be deleted.

An application imports the toolkit by `PUBLIC` alone; other applications where `[tool.importlinter]` lets it.
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
