"""The documentation's pages: their code runs, what they show is compared, what they name exists.

`python docs/build.py` runs all pages and builds them; here is what can be said of them in a moment.
"""

import json
import re
from importlib import import_module
from pathlib import Path

import blocks
import pytest

from calib import cli
from calib.apps.documentation import commands

DOCS, PAGES = blocks.DOCS, blocks.pages()
PAGE = """# A page

```sh
echo "rms 0.123 mm of 40 poses" > said.txt
cat said.txt; echo "more"
```

```text
{shown}
```

```python
value = 3
```

```python
print("value", value)
```

```text
value 3
```

<!-- data: no_such_recording -->
```sh
false
```
"""


def ran(folder: Path, text: str) -> blocks.Report:
    page = folder / "page.md"
    page.write_text(text)
    return blocks.run(page, folder / "run")


def test_page_holds_where_it_prints_as_shown(tmp_path: Path) -> None:
    """A page holds where it shows what it prints."""
    report = ran(tmp_path, PAGE.format(shown="rms 0.121 mm of 40 poses"))  # within the tolerance
    assert report.complaints == [] and len(report.remarks) == 1 and "absent" in report.remarks[0]


@pytest.mark.parametrize("shown", ["rms 0.15 mm of 40 poses", "rms 0.123 mm of 40 points", "rms 0.123 mm of 50 poses"])
def test_changed_number_or_word_is_complaint(tmp_path: Path, shown: str) -> None:
    """Another number or word is a complaint."""
    (complaint,) = ran(tmp_path, PAGE.format(shown=shown)).complaints
    assert "page.md, line 3" in complaint and shown in complaint


def test_fresh_numbers_are_recorded(tmp_path: Path) -> None:
    """Fresh numbers are recorded, and a looser tolerance is stated."""
    text = PAGE.format(shown="rms 0.15 mm of 40 poses")
    assert "rms 0.123 mm of 40 poses\n```" in ran(tmp_path, text).fresh
    (tmp_path / "loose").mkdir()
    assert ran(tmp_path / "loose", text.replace("```text\nrms", "```text within 30 %\nrms")).complaints == []


@pytest.mark.parametrize(("code", "error"), [("exit 3", "exit code 3"), ("false | cat", "exit code 1")])
def test_a_command_that_fails_ends_the_page(tmp_path: Path, code: str, error: str) -> None:
    (complaint,) = ran(tmp_path, f"```sh\n{code}\n```\n\n```sh\ntouch later\n```\n").complaints
    assert error in complaint and not (tmp_path / "run/later").exists()


def test_no_block_of_code_escapes() -> None:
    """Every fence of a language that could run begins a block that does."""
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        fences = re.findall(r"^ *(?:```|~~~)\{?(?:code-cell|sh|bash|console|shell|python|py)\b", text, flags=re.M)
        assert len(fences) == len(blocks.read(text)), page
    assert sum(len(blocks.read(page.read_text(encoding="utf-8"))) for page in PAGES) > 20


@pytest.mark.slow
def test_what_the_concepts_name_exists() -> None:
    for page in (DOCS / "concepts").glob("*.md"):
        for name in re.findall(r"`((?:calib|poses|trajectories)(?:\.\w+)+)`", page.read_text(encoding="utf-8")):
            parts = name.split(".")
            try:
                import_module(name)
            except ModuleNotFoundError:
                assert hasattr(import_module(".".join(parts[:-1])), parts[-1]), (page.name, name)


@pytest.mark.slow
def test_reference_has_all_declared_names() -> None:
    """The reference has all that is declared."""
    import reference

    from calib.procedure import findings, formats

    told = reference.commands()
    for name, one in cli.command_tree().commands.items():
        assert f"### calib {name}\n" in told
        assert all(f"`{option.opts[0]}" in told for option in one.params if option.param_type_name == "option")
    assert all(f"| {code} |" in told for code in "01234")
    assert all(f"### {code}\n" in reference.finding_list() for code in findings.catalogue())
    assert all(f"{term}\n: " in reference.terms() for term in findings.glossary())
    for topic in formats.SCHEMAS:
        shown = reference.topic(topic)
        found = json.loads(formats.json_schema(topic))
        keys = [key for key in found["properties"] if key != "files"]
        assert all(re.search(rf"``{key}[.`]", shown) for key in keys) if topic != "session" else "[poses]" in shown
        said = reference.example_words(topic)
        assert [key for key, _, _, words in formats.keys(topic) if not (words or said.get(key))] == [], "no meaning"


def test_notebooks_are_kept_without_outputs() -> None:
    for path in (DOCS / "notebooks").glob("*.ipynb"):
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        assert all(not cell.get("outputs") and cell.get("execution_count") is None for cell in cells), path.name


def test_command_finds_built_pages(tmp_path, monkeypatch, capsys) -> None:
    """The command finds the built pages, or lists the topics and says how to build them."""
    monkeypatch.setattr(commands, "CLONE", tmp_path / "elsewhere")
    monkeypatch.chdir(tmp_path)
    assert cli.run(["docs"]) == 0
    out = capsys.readouterr().out
    assert "python docs/build.py" in out and "calib docs tracker " in out
    page = tmp_path / "docs/_build/html/index.html"
    page.parent.mkdir(parents=True)
    page.touch()
    assert cli.run(["docs"]) == 0 and str(page) in capsys.readouterr().out


# the slow block of lwr_study.md is run by tests/examples/test_lwr4plus.py
SLOW = [page for page in PAGES if "<!-- slow -->" in page.read_text(encoding="utf-8") and page.stem != "lwr_study"]


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("page", SLOW, ids=[page.stem for page in SLOW])
def test_slow_blocks_run(page: Path, tmp_path: Path) -> None:
    assert blocks.run(page, tmp_path / "run", slow=True).complaints == []


def test_no_page_runs_twice() -> None:
    """The build of `.ci/run` leaves out the pages that the slow test runs, and no other."""
    script = (DOCS.parent / ".ci/run").read_text(encoding="utf-8")
    assert re.findall(r"--without (\S+)", script) == [page.stem for page in SLOW]


@pytest.mark.parametrize("topic", commands.pages())
def test_a_page_is_shown_where_no_pages_are_built(topic, capsys) -> None:
    """Each page is shown as its text, without directives of the builder."""
    assert cli.run(["docs", topic]) == 0
    out = capsys.readouterr().out
    assert out.startswith("# ") and "```{" not in out


def test_a_topic_that_is_not_there_is_said(capsys) -> None:
    assert cli.run(["docs", "trakcer"]) == 2 and "did you mean 'tracker'" in capsys.readouterr().err
