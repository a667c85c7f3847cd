"""An identification that carries on the friction and the prior of an earlier one."""

from dataclasses import replace

import numpy as np
import planted_motion as planted
import pytest

from calib.dynamics import drives
from calib.errors import UsageError
from calib.identification.earlier import DECISIVE, EarlierChoice
from calib.identification.identify import Identification, identify
from calib.identification.rows import Case
from calib.identification.settings import IdentificationSettings
from calib.procedure.dynamic_stage.verdict import parameter_findings

SETTINGS = IdentificationSettings(essential="none")
STRIBECK = (drives.term("Fs1", "stribeck", 0, 0.3, 1.0, 0.01),)


def case(name: str, seed: int) -> Case:
    """Return six seconds of an arm whose first joint has Stribeck friction."""
    return planted.case(name, seed, noise=0.2, duration=6.0, terms=STRIBECK, values={"Fs1": 4.0})


def after(found: Identification, **factors: float) -> EarlierChoice:
    """Return the choice of an identification, with factors of the sizes by the first word of their names."""
    choice = found.choice
    sizes = {name: size * factors.get(name.split(" ")[0], 1.0) for name, size in choice.sizes.items()}
    terms = {term.name: term for term in found.friction.terms}
    return EarlierChoice("earlier", tuple(terms[name] for name in choice.terms), replace(choice, sizes=sizes))


def codes(found: Identification) -> set[str]:
    return {finding.code for finding in parameter_findings(found)}


@pytest.fixture(scope="module")
def first() -> Identification:
    return identify(planted.arm(), [case("a", 0)], SETTINGS)


@pytest.fixture(scope="module")
def both() -> list[Case]:
    return [case("a", 0), case("b", 7)]


def test_choice_is_carried_on(first, both):
    """Terms, ridges and sizes are those of the earlier identification, not those that all recordings would give."""
    continued = identify(planted.arm(), both, replace(SETTINGS, earlier=after(first)))
    anew = identify(planted.arm(), both, SETTINGS)
    assert set(anew.choice.terms) != set(first.choice.terms)
    assert anew.choice.sizes != pytest.approx(first.choice.sizes, rel=0.01)
    assert continued.choice.terms == first.choice.terms
    assert continued.choice.ridges == pytest.approx(first.choice.ridges)
    assert continued.choice.sizes == pytest.approx(first.choice.sizes)
    assert codes(continued).isdisjoint({"earlier-prior-left", "earlier-friction-extended"})


def test_sizes_that_the_recordings_contradict_are_left(first, both):
    """Bodies a thousand times lighter than they are: sizes are chosen anew, and this is said."""
    found = identify(planted.arm(), both, replace(SETTINGS, earlier=after(first, bodies=1e-3, whole=1e-3)))
    assert found.settings.earlier is not None and found.settings.earlier.contradiction > np.log(DECISIVE)
    assert found.choice.sizes["whole"] == pytest.approx(first.choice.sizes["whole"], rel=0.2)
    assert "earlier-prior-left" in codes(found)


def test_friction_that_is_clearly_missing_is_added(first, both):
    """An earlier identification without Stribeck friction does not keep a later one from it."""
    choice = replace(first.choice, terms=(), groups=(), ridges=())
    earlier = EarlierChoice("earlier", (), choice)
    found = identify(planted.arm(), both, replace(SETTINGS, earlier=earlier))
    assert {"Fs1", "Fs1.2"} <= set(found.choice.terms)
    assert "earlier-friction-extended" in codes(found)


@pytest.mark.parametrize("sizes", [{"whole": 1.0}, {"motors of others [kg]": 1.0}])
def test_prior_of_other_parameters_is_refused(first, both, sizes):
    """Fewer sizes than those of these parameters, or sizes that these parameters do not have."""
    choice = after(first)
    other = replace(choice, choice=replace(choice.choice, sizes={**sizes}))
    with pytest.raises(UsageError, match="other drive terms, torque rows or payloads"):
        identify(planted.arm(), both, replace(SETTINGS, earlier=other))
