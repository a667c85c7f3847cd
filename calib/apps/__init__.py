"""Applications: commands beside the procedure, each a package that can be deleted.

An application imports from the toolkit only what `PUBLIC` names, and other applications only where the layers of
`[tool.importlinter]` allow it.
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
