"""Option files of every kind: whatever they hold, they are read or refused in one form, never with a traceback."""

import copy
import datetime
import json
import math
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any, get_type_hints

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from jsonschema import Draft202012Validator
from option_files import FILES

from calib.cli import run
from calib.config import located, parse, read_toml, schema
from calib.config_types import Hidden, number, shown
from calib.errors import CalibError, RobotError, UsageError
from calib.identification import identify_options
from calib.procedure.formats import SCHEMAS
from calib.procedure.measuring.constraints_file import ConstraintsFile

FEW = settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.too_slow])
MANY = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])


LEAVES = st.one_of(
    st.none().map(lambda _: datetime.date(1979, 5, 27)), st.just(datetime.time(7, 32)), st.booleans(),
    st.integers(), st.sampled_from([10**400, -(10**30), 0, -1]), st.floats(), st.text(max_size=20),
    st.sampled_from(["1/0", "pi*" * 5000 + "1", "(" * 300, "90 deg", "1e999", "()", "9" * 5000, "\0", "1 m", "inf"]),
)  # fmt: skip
VALUES = st.recursive(
    LEAVES, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=3)
)


def places(table: Any, above: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the place of every value in a table, and of a key beside each."""
    for key, value in table.items() if isinstance(table, dict) else enumerate(table):
        yield (*above, key)
        if isinstance(value, (dict, list)):
            yield from places(value, (*above, key))
    if isinstance(table, dict):
        yield (*above, "kind of nothing")


def check_wrong_value(kind: str, data: st.DataObject) -> None:
    """Check that a wrong value is one line of complaint, and what is read, accepted by the JSON schema, too."""
    base, read = FILES[kind]
    table = copy.deepcopy(base)
    *way, key = data.draw(st.sampled_from(list(places(base))))
    place = table
    for part in way:
        place = place[part]
    place[key] = data.draw(VALUES)
    try:
        read(table)
    except (UsageError, RobotError) as error:
        assert len(str(error)) < 2500 and "pydantic" not in str(error)
        return
    if kind in SCHEMAS and known_to_json(table):
        assert not list(validator(kind).iter_errors(table))


@pytest.mark.parametrize("kind", FILES)
@FEW
@given(data=st.data())
def test_wrong_value_is_one_complaint_line(kind: str, data: st.DataObject) -> None:
    """What is read, its JSON schema accepts, too: an editor shows no error where there is none."""
    check_wrong_value(kind, data)


@pytest.mark.slow
@pytest.mark.parametrize("kind", FILES)
@MANY
@given(data=st.data())
def test_wrong_values_by_the_dozen(kind: str, data: st.DataObject) -> None:
    check_wrong_value(kind, data)


def known_to_json(value: Any) -> bool:
    """Return whether JSON knows the value; a date of TOML is a text to an editor, and no JSON to this validator."""
    if isinstance(value, datetime.date | datetime.time):
        return False
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return all(map(known_to_json, inner)) and not (isinstance(value, float) and not math.isfinite(value))


def validator(kind: str) -> Draft202012Validator:
    module, name = SCHEMAS[kind]
    return Draft202012Validator(schema(getattr(import_module(module), name), kind))


@pytest.mark.parametrize("kind", SCHEMAS)
def test_schema_has_the_known_keys_alone(kind: str, capsys: pytest.CaptureFixture) -> None:
    """The JSON schema knows every key, and refuses others."""
    assert run(["formats", kind, "--schema"]) == 0
    found = json.loads(capsys.readouterr().out, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert found["$schema"] == "https://json-schema.org/draft/2020-12/schema"
    Draft202012Validator.check_schema(found)
    assert '"null"' not in json.dumps(found), "TOML has none"
    base = FILES[kind][0]
    module, name = SCHEMAS[kind]
    hints = get_type_hints(getattr(import_module(module), name), include_extras=True)
    keys = {key for key, hint in hints.items() if Hidden() not in getattr(hint, "__metadata__", ())}
    assert set(found["properties"]) == keys
    ours = Draft202012Validator(found)
    assert not list(ours.iter_errors({key: value for key, value in base.items() if key not in ("slow",)}))
    for key in base:
        assert list(ours.iter_errors(base | {key: datetime.date(1979, 5, 27)})), key
        assert list(ours.iter_errors(base | {f"{key}z": base[key]})), key


def test_topic_without_schema_lists_others(capsys: pytest.CaptureFixture) -> None:
    """A topic without a schema says which topics have one."""
    assert run(["formats", "moveit", "--schema"]) == 2
    assert "available for options, identify-options" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"a = 1" + b"0" * 400, "a: a whole number of more than 64 bits"),
        (b"a = 1" + b"0" * 5000, "a whole number with thousands of digits"),
        (b"a = " + b"[" * 5000 + b"]" * 5000, "is nested too deeply"),
        (b"a = " + b"{b=" * 5000 + b"1" + b"}" * 5000, "is nested too deeply"),
        (b"a." * 5000 + b"a = 1", "is nested too deeply"),
        (b"a = " + b"[" * 40 + b"]" * 40, "is nested too deeply: more than 32 levels"),
        (b"a = 1\nb = \n", "is not a TOML file.*line 2"),
        (b"a = '\xff'", "is not a TOML file"),
        (b"# " + b"x" * 8_000_000, "is larger than 8 MB"),
        (b"a = 2021-13-40", "is not a TOML file"),
    ],
)
def test_hostile_files_get_a_message(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "a.toml"
    path.write_bytes(content)
    with pytest.raises(UsageError, match=rf"a\.toml: .*{words}"):
        read_toml(path)


def test_what_is_no_file(tmp_path: Path) -> None:
    (tmp_path / "loop.toml").symlink_to(tmp_path / "loop.toml")
    for name in ("absent.toml", ".", "loop.toml", "x" * 300, "a\0b"):
        with pytest.raises(UsageError):
            read_toml(f"{tmp_path}/{name}")
    (tmp_path / "mark.toml").write_bytes(b"\xef\xbb\xbfa = 1\r\n")
    assert read_toml(tmp_path / "mark.toml") == {"a": 1}


def test_places_are_named_as_toml_names_them() -> None:
    assert located(("sigma", "position")) == "sigma.position"
    assert located(("files", "day 2.csv", "kind")) == 'files."day 2.csv".kind'
    assert located(("obstacle", 1, "size")) == "[[obstacle]] number 2, size"
    assert located(("obstacle", 0)) == "[[obstacle]] number 1"


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"obstacle": 5}, r"expected a list of tables, \[\[obstacle\]\], found 5"),
        ({"obstacle": [{"kind": "box"}]}, r"\[\[obstacle\]\] number 1: there is no 'size'; needed are kind, size"),
        ({"obstacle": [{"kind": "bax", "size": [1]}]}, r"\[\[obstacle\]\] number 1, kind: expected one of.*mean 'box'"),
        ({"obstacle": [{"kind": "box", "size": [-1, 1, 1]}]}, "number 1, size: expected lengths above 0"),
        ({"target": {"reach": -1}}, "target.reach: expected a number above 0, found -1"),
        ({"target": {"facing": [0, 0, 0]}}, r"target: facing: \[0, 0, 0\] is not a direction"),
        ({"target": {"height": [1, 0]}}, "target: height: 1 is not below 0"),
        ({"target": {"height": "1 rad"}}, "target.height: cannot read '1 rad' as a number .here .*: m, mm, um, cm, in"),
        ({"instrument": {"xyz": [0, 0, 1], "sight": "-10 deg"}}, "instrument.sight: expected a number above 0"),
        ({"instrument": {"sight": "40 deg"}}, "instrument: sight needs the position of the instrument, xyz"),
        ({"collision": {"margin": -1}}, "collision.margin: expected 0 or more, found -1"),
        ({"joints": {"q1": [1, 2, 3]}}, "joints.q1: expected a list of 2 numbers, lower and upper"),
    ],
)
def test_constraints_that_cannot_be(table: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        parse(ConstraintsFile, table, "c.toml")


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"gains": [10, 0]}, "gains: expected finite numbers other than zero"),
        ({"filter": {"order": 2.0}}, "filter.order: expected a whole number from 1 to 12, found 2.0"),
        ({"recording": {"names": {"torqe": "x"}}}, "names: 'torqe' is not a known name .did you mean 'torque'"),
        ({"recording": {"rows": "both"}}, "recording: there is no key 'rows'"),
        (
            {"term": [{"name": "x", "shape": "sine"}]},
            r"\[\[term\]\] number 1 .'x'.: there is no 'joint'; needed are name",
        ),
        ({"term": {"name": "x"}}, r"expected a list of tables, \[\[term\]\]"),
        ({"coupling": [{"joints": [1, 0]}]}, r"number 1, joints: expected two joint numbers, counted from 1"),
        ({"slow": [0.1, -1]}, "slow: expected a number above 0, found -1"),
        ({"files": {"run": {"npz": {"gains": [1.0]}}}}, r'the dot needs quotes: \[files."run.npz"\]'),
        ({"files": {"a.npz": {"payload": ["tool"]}}}, 'files."a.npz".payload: there is no key .tool.; there are none'),
        ({"constraints": {"sum": [{"weights": {"Fv5": "a"}}]}}, "weights.Fv5: expected a number, found 'a'"),
        ({"payload": 3}, "payload: expected a table, found 3"),
        ({"gain_identification": {"loaded": "a"}}, "there is no 'unloaded'; needed are unloaded, loaded"),
    ],
)
def test_identify_options_that_cannot_be(table: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        identify_options.parse_options(table)


def test_common_values_reach_each_recording() -> None:
    """What holds for every recording is handed down to each of them."""
    table = {"filter": {"band": 5.0, "order": 2}, "gains": [1.0], "files": {"a.npz": {"filter": {"band": 7.0}}}}
    found = identify_options.parse_options(table)
    own = found.file_settings("x/a.npz")
    assert (own.filter.band, own.filter.order, own.gains, own.payload) == (7.0, 2, (1.0,), ())
    assert found.file_settings("b.npz").filter.band == 5.0
    assert identify_options.parse_options({"gains": [10, 10**25]}).every.gains == (10.0, 1e25)


@FEW
@given(st.text(max_size=40) | st.text("0123456789.+-*/() pie degmm", max_size=60))
def test_expression_is_number_or_complaint(text: str) -> None:
    """An expression is a number or a complaint."""
    try:
        assert not math.isnan(number(text, "x", "angle"))
    except CalibError as error:
        assert str(error).startswith("x: ")


@given(st.integers() | st.floats() | st.text() | st.lists(st.integers()) | st.dates())
def test_a_value_is_shown_in_about_a_line(value: Any) -> None:
    assert len(shown(value)) < 400 and "\n" not in shown(value)


def test_nothing_but_a_file_loads_pydantic(loaded: dict[str, set[str]]) -> None:
    assert "pydantic" not in loaded["no options file"] and "pydantic" in loaded["options file"]
