"""Instruments by name, for `calib new`: what they measure and how well, as starting values in ``session.toml``."""

from __future__ import annotations

from dataclasses import dataclass

from calib.errors import UsageError


@dataclass(frozen=True)
class InstrumentPreset:
    """What is measured (``pose`` or ``position``) and the sigmas of one measurement [m], [rad]; 0: to be estimated."""

    label: str
    measures: str
    sigma_position: float
    sigma_orientation: float
    source: str


INSTRUMENTS = {
    "cmm": InstrumentPreset(
        "optical CMM", "pose", 60e-6, 0.2e-3, "Nikon K610: 60 µm volumetric; orientation our guess"
    ),
    "tracker": InstrumentPreset(
        "laser tracker", "position", 20e-6, 0.0, "about 15 µm + 6 µm/m in a small cell; our guess"
    ),
    "tracker6d": InstrumentPreset("laser tracker, 6-D probe", "pose", 30e-6, 0.1e-3, "our guess"),
    "mocap": InstrumentPreset("motion capture", "pose", 0.0, 0.0, "estimated from the residuals"),
    "camera": InstrumentPreset("camera and board", "pose", 0.0, 0.0, "estimated from the residuals"),
    "other-pose": InstrumentPreset("instrument", "pose", 0.0, 0.0, "estimated from the residuals"),
    "other-position": InstrumentPreset("instrument", "position", 0.0, 0.0, "estimated from the residuals"),
}


def instrument(name: str) -> InstrumentPreset:
    """Return an instrument by name.

    Raises:
        UsageError: with the names there are.
    """
    if name not in INSTRUMENTS:
        known = ", ".join(f"{key} ({each.label}, {each.measures})" for key, each in INSTRUMENTS.items())
        raise UsageError(f"no instrument '{name}'; there are {known}")
    return INSTRUMENTS[name]
