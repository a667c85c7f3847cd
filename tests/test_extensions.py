"""Extension points: every offer loads; what is misspelt or raises is told by name."""

import re
import sys
from collections import Counter
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import pytest

from calib import cli, extensions
from calib.errors import UsageError
from calib.extensions import POINTS, Point

ROOT = Path(__file__).parents[1]
HOST = import_module("calib.apps")
DECLARED = re.compile(r"""^[A-Z0-9_]+: "?Point\[[^=]*\]"? = \(?\s*Point\(\s*"(?P<name>\w+)\b""", re.M)


@pytest.fixture
def add(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str, str], None]:
    """Adds a package with this text as its ``__init__.py``."""
    monkeypatch.setattr(HOST, "__path__", [*HOST.__path__, str(tmp_path)])

    def written(name: str, text: str) -> None:
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text(text)
        monkeypatch.delitem(sys.modules, f"{HOST.__name__}.{name}", raising=False)
        extensions._offers.cache_clear()

    yield written
    extensions._offers.cache_clear()


def test_every_offer_loads():
    for name in POINTS:
        assert Point(name, "").all(), name


def test_points_are_declared_once_with_type():
    """Every point is declared once with its type."""
    sources = [path.read_text(encoding="utf-8") for path in (ROOT / "calib").rglob("*.py")]
    declared = [match for source in sources for match in DECLARED.finditer(source)]
    assert Counter(match["name"] for match in declared) == Counter(POINTS) and len(POINTS) <= 10
    assert [source for source in sources if "Point[Any]" in source] == []


def test_a_misspelt_point_is_told(add):
    add("extra", "OFFERS = {'comands': 'commands:app'}")
    words = r"calib\.apps\.extra: OFFERS: there is no extension point 'comands' \(did you mean 'commands'\?\)"
    with pytest.raises(UsageError, match=words):
        Point("formats", "").all()
    with pytest.raises(ValueError, match="did you mean 'formats'"):
        Point("format", "")


def test_a_misspelt_name_is_told(add):
    add("extra", "OFFERS = {'formats': ':FORMAT'}\nFORMATS = {}")
    with pytest.raises(UsageError, match=r"extra: OFFERS: :FORMAT: there is no 'FORMAT' \(did you mean 'FORMATS'\?\)"):
        Point("formats", "").all()


def test_an_extension_that_raises_is_told(add):
    add("extra", "OFFERS = {'commands': 'commands:app'}\nimport nothing_of_the_kind")
    words = r"the extension calib\.apps\.extra does not load: ModuleNotFoundError: .*'nothing_of_the_kind'; correct it"
    with pytest.raises(UsageError, match=words):
        Point("commands", "").all()


def test_the_command_line_tells_it(add, capsys):
    add("extra", "OFFERS = {'commands': 'commands:app'}")
    cli.command_tree.cache_clear()
    assert cli.run(["formats", "mdh"]) == 2
    assert "the extension " in capsys.readouterr().err
