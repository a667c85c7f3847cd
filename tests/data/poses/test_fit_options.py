"""The options file: every key is read, every unknown one refused by name."""

import dataclasses
import re

import pytest

from calib.config import parse
from calib.data.poses import fit_options as module
from calib.data.poses.fit_options import FitOptions, check_files, parse_options, read_options
from calib.errors import UsageError
from calib.procedure.session.settings import InstrumentSection


def test_defaults_without_a_file():
    options = read_options()
    assert options == FitOptions() and options.model == "auto" and options.loss == "auto"
    assert options.for_file("any.csv") is options and options.check_limits


def test_docstring_schema_is_complete(tmp_path):
    """The schema of the docstring is valid and complete."""
    schema = (module.__doc__ or "").split("::\n", 1)[1]
    path = tmp_path / "fit.toml"
    path.write_text(re.sub(r"(?m)^    ", "", schema))
    options = read_options(path)
    every, sigma = options.for_file("any.csv"), options.sigma
    assert every.kind == "position" and every.groups == ("tool_position",) and every.socket_pairs == (("0", "1"),)
    assert sigma.position == (1e-5, 1e-5, 2e-5) and sigma.orientation == (1e-4,) * 3
    assert (sigma.distance, sigma.floor) == (1e-5, 1e-6)
    assert every.where == {"tool_position": ("back_left", "high")} and every.columns == {"x": "X_leica"}
    assert options.prior == {"theta2": 1e-3}
    assert options.fix == ("theta1",) and options.free == ("d3",) and options.loss_scale == 1.345
    for key in (f.name for f in dataclasses.fields(FitOptions) if f.name != "source"):
        assert re.search(rf"(?m)^    \[?{key}\b", schema), f"{key} is not in the docstring"


def test_files_table_adds_to_common_options():
    """A file's table adds to what holds for every file."""
    day2 = {"kind": "pose", "units": {"position": "m"}, "station": "B"}
    every = {"kind": "position", "units": {"joints": "deg", "position": "mm"}, "sigma": {"position": 1e-5}}
    options = parse_options({**every, "files": {"day2.csv": day2, "a/day3.csv": {"tool": "T"}}})
    own = options.for_file("/data/day2.csv")
    assert own.kind == "pose" and own.units == {"joints": "deg", "position": "m"} and own.station == "B"
    assert own.sigma.position == (1e-5,) * 3
    assert options.for_file("/data/a/day3.csv").tool == "T" and options.for_file("/data/day3.csv").tool == "tool"
    assert options.for_file("/data/day1.csv").kind == "position"
    check_files(options, ["/data/day2.csv", "a/day3.csv"])
    with pytest.raises(UsageError, match=r'files."day2.csv" is not among the files given .did you mean .day_2.csv'):
        check_files(options, ["day_2.csv", "a/day3.csv"])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ({"modle": "auto"}, "there is no key 'modle' .did you mean 'model'"),
        ({"files": {"a.csv": {"model": "auto"}}}, "there is no key 'model'.*the keys are"),
        ({"files": {"a": {"csv": {"kind": "pose"}}}}, "the dot needs quotes"),
        ({"sigma": {"positon": 1e-5}}, "sigma: there is no key 'positon' .did you mean 'position'"),
        ({"kind": "poses"}, "kind: expected one of pose.*did you mean 'pose'.*found 'poses'"),
        ({"model": "stifness"}, "did you mean 'stiffness'"),
        ({"loss": "l1"}, "loss: expected one of auto, none, huber, cauchy"),
        ({"units": {"x": "furlong"}}, "units.x: expected one of rad"),
        ({"sigma": {"position": [1e-5, 1e-5]}}, "a number or three"),
        ({"sigma": {"position": 20}}, "at most 0.1 .are these mm"),
        ({"sigma": {"position": -1e-5}}, "a number above 0"),
        ({"sigma": 1e-5}, "sigma: expected a table"),
        ({"socket_distance": 50}, "socket_distance: expected a number .m., at most 10 .are these mm"),
        ({"socket_pairs": ["0", "1"]}, "pairs of socket labels"),
        ({"check_limits": 0}, "check_limits: expected true or false, found 0"),
        ({"fix": "theta1"}, "fix: expected a list of names"),
        ({"fix": ["d3"], "free": ["d3"]}, "'d3' is in fix and in free"),
        ({"free": []}, "free: the list is empty; remove the key to free all parameters"),
        ({"prior": {"d3": 1e-300}}, "prior.d3: expected a number, at least 1e-12"),
        ({"prior": {"d3": 0}}, "prior.d3: expected a number above 0"),
        ({"where": {"day": True}}, "where.day: expected a text or a number"),
        ({"columns": {"x": 3}}, "columns.x: expected a text"),
    ],
)
def test_what_a_key_cannot_be(text, words):
    with pytest.raises(UsageError, match=words):
        parse_options(text)


def test_files_that_are_no_toml(tmp_path):
    path = tmp_path / "fit.toml"
    with pytest.raises(UsageError, match="cannot be read"):
        read_options(path)
    path.write_text("kind = position")
    with pytest.raises(UsageError, match=r"fit.toml: is not a TOML file.*line 1"):
        read_options(path)


@pytest.mark.parametrize("sigma", [1e-300, 1e-11, 0.2, 1e300])
def test_implausible_sigma_is_refused(sigma):
    """A sigma that no instrument has is refused, in options and session alike."""
    words = r"expected a number \[m\], at least 1e-10 and at most 0.1 \(are these mm, or degrees\?\), found "
    with pytest.raises(UsageError, match="sigma.position: " + words):
        parse_options({"sigma": {"position": sigma}})
    section = {"name": "tracker", "measures": "position"}
    with pytest.raises(UsageError, match="sigma_position: " + words):
        parse(InstrumentSection, section | {"sigma_position": sigma}, "s")
    assert parse(InstrumentSection, section | {"sigma_position": 0}, "s").sigma_position == 0.0, "to be estimated"
