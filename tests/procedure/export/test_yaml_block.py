"""What our YAML writer writes is what PyYAML, a reader of YAML 1.1, reads."""

import pytest

from calib.procedure.export.joint_origins import block

yaml = pytest.importorskip("yaml")


def test_numbers_are_read_to_the_last_digit() -> None:
    """Numbers are read as numbers to the last digit."""
    values = {str(k): x for k, x in enumerate((1e-5, -1e22, 0.1, 0.0, 1.5e-300, 2.0**0.5))}
    read = yaml.safe_load(block({"joint": {"position": values}}))["joint"]["position"]
    assert read == values and all(isinstance(x, float) for x in read.values())


NAMES = ["yes", "Off", "y", "1", "a: b", "#1", "Gelenk ä", 'with "quotes"', "null", "", "- a", "joint_1/a"]


@pytest.mark.parametrize("name", NAMES)
def test_names_are_read_as_texts(name: str) -> None:
    assert yaml.safe_load(block({"joints": {name: {"x": name}}})) == {"joints": {name: {"x": name}}}


def test_nothing_is_an_empty_mapping() -> None:
    assert yaml.safe_load(block({"calibration": {"joints": {}}})) == {"calibration": {"joints": {}}}
