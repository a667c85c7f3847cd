"""Names of the columns by which files are joined, in any spelling."""

import re
from collections.abc import Sequence

from calib.data.csv_table import Table

NAMES = ("name", "point", "pointname", "pointid", "pose", "poseid", "id", "label", "target", "number", "no", "nr")
CLOCKS = ("t", "time", "timestamp", "datetime")


def column_of(table: Table, known: Sequence[str]) -> str:
    """Return the table's first column that has one of the `known` names, in any spelling; "" without any."""
    plain = {re.sub(r"[^a-z0-9]", "", name.lower()): name for name in reversed(table.header)}
    return next((plain[name] for name in known if name in plain), "")
