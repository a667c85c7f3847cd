"""The catalogue of findings: wording and rules are tested here, once; elsewhere tests ask for codes and values."""

import ast
import re
from pathlib import Path
from string import Formatter

import produced
import pytest
from recordings import DATA

from calib.data.poses import fit_options
from calib.errors import finding
from calib.identification import identify_options
from calib.procedure import findings
from calib.procedure.findings import RANKS, Verdict, catalogue, level_of, lines_of, sentence, settle

PRIVATE = r"\b(un)?(told|drawn|draws?|carried|carries|heard|beside)\b"
CODES = sorted(catalogue())


@pytest.mark.parametrize("code", CODES)
def test_entry_is_short_plain_and_complete(code):
    """An entry is short, plain and complete."""
    entry = catalogue()[code]
    assert not re.search(PRIVATE, f"{entry.says} {entry.advice} {entry.means}")
    levels = {entry.level, *(level for steps in entry.limits.values() for level in steps)}
    assert levels <= set(RANKS[1:]) and entry.says
    if levels & {"marginal", "fail"}:
        words = re.sub(
            r"\{[^} ]*( [^}°]+)?\}", lambda value: "x x" if value[1] else "x", re.sub("<[^<>]*>", "", entry.says)
        )
        assert len(words.split()) <= 13, "a verdict has 25 words, figures included"


def test_accept_names_match_the_catalogue():
    """Each printed ``accept`` is taken by the options of the command that prints it, and these take no other."""
    text = Path(findings.__file__).with_suffix(".toml").read_text(encoding="utf-8")
    chapters = [set(re.findall('^accept = "(.+)"$', one, re.M)) for one in text.split("\n# ---- ")]
    assert chapters[1] == set(fit_options.FINDINGS) and chapters[9] | chapters[10] == set(identify_options.FINDINGS)
    assert set().union(*chapters) == chapters[1] | chapters[9] | chapters[10]


@pytest.mark.slow
def test_every_entry_is_used():
    sources = "".join(path.read_text(encoding="utf-8") for path in Path(findings.__file__).parents[1].rglob("*.py"))
    assert [code for code in CODES if f'"{code}"' not in sources] == []


@pytest.mark.slow
def test_every_entry_is_produced(pytestconfig):
    """Real and spoiled files of all tests, quick and slow, together make the sources say every entry."""
    if pytestconfig.getoption("findings") != "compare":
        pytest.skip("needs pytest --findings note, with -m slow, too; then --findings compare -m slow for this test")
    missing = sorted({code for code in CODES if not code.startswith("earlier")} - produced.kept(pytestconfig))
    if missing and not DATA.is_dir():
        pytest.skip(f"some are said of real recordings alone, and there are none at {DATA}: {', '.join(missing)}")
    assert missing == []


def test_findings_have_the_values_they_need():
    """Every finding of the code has the values its entry needs."""
    made = {}
    for path in Path(findings.__file__).parents[1].rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(text)) if "finding(" in text else ():
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "finding" and node.args:
                names = {word.arg for word in node.keywords}
                for code in ast.walk(node.args[0]):  # of a choice between two codes, both
                    if isinstance(code, ast.Constant) and code.value in catalogue():
                        made.setdefault(code.value, []).append(names)
    for code, calls in made.items():
        entry = catalogue()[code]
        text = re.sub("[<>]", "", f"{entry.says} {entry.advice}")
        needed = {name for _, name, _, _ in Formatter().parse(text) if name} | set(entry.limits)
        assert all(None in names or needed <= names for names in calls), code


def test_level_is_mildest_and_verdict_worst():
    """A level is the mildest of its limits, and a verdict the worst of its findings."""
    scale = dict(factor=1.01, sigma=1e-4)
    mild, none, sound = (
        finding("scale", off=off, explained=x, **scale) for off, x in ((1e-2, 0.5), (1e-2, 0.1), (0, 1))
    )
    assert [level_of(one) for one in (mild, none, sound)] == ["marginal", "", ""]
    worst = finding("moved", elements=("a", "b", "c", "d"), times=7.0)
    found = settle([mild, none, worst])
    assert [one.code for one in found] == ["moved", "scale"]
    verdict = Verdict.of("1 mm", found)
    assert (verdict.level, verdict.code) == ("fail", "moved") and verdict.reason.startswith("1 mm; ")
    assert Verdict.of("1 mm", settle(found, ["moved", "scale"])) == Verdict("pass", "1 mm")
    assert (
        'accept = ["moved"]' in lines_of(found)[0]
        and "accepted by the options" in lines_of(settle(found, ["moved"]))[1]
    )
    assert "a and 3 more" in sentence(worst)


def test_part_without_value_is_left_out():
    """A part without its value is left out."""
    rank = dict(rank=3, parameters=4, tolerance=1e-6, last=0.1)
    assert "gap" in sentence(finding("rank", next=1e-9, **rank))
    assert "gap" not in sentence(finding("rank", next=None, **rank))


def test_the_command_explains_a_code(calib):
    code, out, _ = calib("explain", "moved")
    assert code == 0 and "fail where times > 5" in out and 'accept = ["moved"]' in out
    assert "validation.csv: too few unseen poses (5 of 8)" in calib("explain", "few-unseen-poses")[1]
    assert calib("explain")[1].splitlines() == [*catalogue(), *findings.glossary()]
    assert "left out of the fit" in calib("explain", "Cross-validated")[1]
    code, _, err = calib("explain", "mover")
    assert code == 2 and "did you mean 'moved'" in err


def test_the_glossary_is_plain_and_complete():
    for term, meaning in findings.glossary().items():
        assert not re.search(PRIVATE, meaning) and len(meaning.split()) <= 32 and meaning.endswith("."), term
    assert 50 <= len(findings.glossary()) <= 80 and not set(findings.glossary()) & set(catalogue())


@pytest.mark.parametrize("code", CODES)
def test_explanation_is_an_example(code):
    """An explanation shows a message as users get it: values, and neither braces nor brackets of a template."""
    values = findings.example(code).values
    entry = catalogue()[code]
    names = [name for _, name, _, _ in Formatter().parse(f"{entry.says} {entry.advice}") if name]
    required = [name for _, name, _, _ in Formatter().parse(re.sub("<[^<>]*>", "", f"{entry.says} {entry.advice}"))]
    missing = {name for name in names if name not in values}
    assert not missing, f"calib/procedure/finding_examples.toml needs values of {missing}, under [any] or [{code}]"
    assert not [name for name in required if name and values[name] in findings.OMITTED_VALUES]
    text = "; ".join(findings.example_texts(code))
    assert findings.example_texts(code)[0] in findings.explain(code)
    assert not re.search(r"[{}<>]", text.replace("> ", "").replace("->", "").replace(">=", "")), text


def test_examples_are_of_findings():
    """Each table of examples is of a finding of the catalogue, and sets what its texts have."""
    tables = dict(findings._example_values())
    tables.pop("any")
    for code, values in tables.items():
        entry = catalogue()[code]
        names = {name for _, name, _, _ in Formatter().parse(f"{entry.says} {entry.advice}") if name}
        assert set(values) <= names, f"[{code}]: {set(values) - names} are none of its values"
