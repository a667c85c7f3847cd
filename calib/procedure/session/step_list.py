"""The steps of a session in their order: what each reads, and what it makes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from calib.folders import CERTIFICATE
from calib.procedure.excitation import coefficients
from calib.procedure.kinematic_stage.folder import URDF
from calib.procedure.session import certificate, dynamics_steps, geometry_steps
from calib.procedure.session.folder import (
    AS_GIVEN,
    CUTS,
    MARK,
    MOTION_CHECKED,
    POSES,
    POSES_CHECKED,
    PREDICTED,
    PREDICTION,
    SELECTION,
    SUMMARY,
    UNSEEN,
    VERDICT,
    WAYS,
    Session,
)

Say = Callable[[str], None]


@dataclass(frozen=True)
class SessionStep:
    """One step.

    Attributes:
        name, purpose: for people.
        settings: sections of ``session.toml`` it depends on, or single keys of them (``dynamics.period``).
        inputs: the files it reads, as they are now.
        make: runs it; returns what is to be said.
        outputs: names or patterns, relative to the session, of what it makes.
        stage: ``geometry`` or ``dynamics``, where only sessions with that have it.
    """

    name: str
    purpose: str
    settings: tuple[str, ...]
    inputs: Callable[[Session], list[Path]]
    make: Callable[[Session, Say], list[str]]
    outputs: tuple[str, ...]
    stage: str = ""


def _robot(session: Session) -> list[Path]:
    return [geometry_steps.robot_file(session)]


def _plan(session: Session) -> list[Path]:
    name = session.settings.poses.constraints
    return [*_robot(session), *([session.path(name)] if name else [])]


def _arrived(session: Session) -> list[Path]:
    brought = [*geometry_steps.measured_files(session)[0], *geometry_steps.measured_again(session)]
    measured = geometry_steps.all_files(brought)
    return [*_robot(session), session.path(f"2-poses/{POSES}"), *_options(session), *measured]


def _options(session: Session) -> list[Path]:
    name = session.settings.fit.options
    return [session.path(name)] if name else []


def _fitted(session: Session) -> list[Path]:
    measured = geometry_steps.all_files(geometry_steps.measured_files(session)[0])
    return [*_robot(session), *_options(session), *measured]


def _validated(session: Session) -> list[Path]:
    fit = [session.fit.robot, session.fit.report]
    return [
        *fit,
        session.path(f"2-poses/{UNSEEN}"),
        *_options(session),
        *geometry_steps.all_files(geometry_steps.measured_files(session)[1]),
    ]


def _excited(session: Session) -> list[Path]:
    name = session.settings.dynamics.limits
    return [session.fit.robot, *([session.path(name)] if name else [])]


def _recorded(session: Session) -> list[Path]:
    plan = session.path(f"6-excitation/training/{coefficients.NAME}")
    return [session.fit.robot, plan, *_reading(session), *_files_of(dynamics_steps.recordings(session)[0])]


def _reading(session: Session) -> list[Path]:
    name = session.settings.dynamics.options
    return [session.path(name)] if name else []


def _identified(session: Session) -> list[Path]:
    own = [session.fit.robot, session.path(CUTS), *_reading(session)]
    return [*own, *_files_of(dynamics_steps.recordings(session)[0])]


def _predicted(session: Session) -> list[Path]:
    found = session.identification
    own = [found.robot, found.model, found.numbers]
    plan = session.path(f"6-excitation/validation/{coefficients.NAME}")
    training, unseen = dynamics_steps.recordings(session)
    cuts = session.path(CUTS)
    return [*own, plan, cuts, *_reading(session), *_files_of(training), *_files_of(unseen)]


def _files_of(paths: list[Path]) -> list[Path]:
    """Return the files behind paths, some of which are folders (ROS 2 bags)."""
    return [each for path in paths for each in (sorted(p for p in path.rglob("*") if p.is_file()) or [path])]


def _exported(session: Session) -> list[Path]:
    own = [*_robot(session), session.fit.robot]
    if session.geometric:
        own += [session.fit.urdf, session.validation.judged]  # a failed robot's files say so
    found = session.identification
    return own + ([found.model, *found.tables, found.unseen.report] if session.dynamic else [])


def _certified(session: Session) -> list[Path]:
    made = [session.path(VERDICT)]
    if session.geometric:
        made = [session.fit.report, session.validation.judged, session.path(f"{session.export}/{URDF}")]
        made += [session.path(SELECTION), session.path(POSES_CHECKED)]
    if session.dynamic:
        found = session.identification
        made += [session.path(MOTION_CHECKED), found.numbers, found.tables[0], found.unseen.report]
    return [*made, *([session.path(MARK)] if session.path(MARK).exists() else [])]


PLAN = "plan validation period harmonics rate starts evaluations limits"
MODEL = "torques friction method options payloads holdout"


def _keys(names: str) -> tuple[str, ...]:
    return tuple(f"dynamics.{name}" for name in names.split())


STEPS = (
    SessionStep("describe", "read the robot", ("robot",), _robot, geometry_steps.describe, (SUMMARY, f"{AS_GIVEN}/*")),
    SessionStep(
        "select", "choose the poses to measure", ("robot", "instrument", "poses", "seed"), _plan, geometry_steps.select,
        (f"2-poses/{POSES}", f"2-poses/{WAYS}", f"2-poses/{UNSEEN}", SELECTION, PREDICTED, PREDICTION),
        "geometry",
    ),
    SessionStep(
        "measure", "check what was measured", ("robot", "instrument", "poses", "fit"), _arrived, geometry_steps.arrive,
        (POSES_CHECKED,), "geometry",
    ),
    SessionStep(
        "fit", "fit the geometry", ("robot", "instrument", "fit", "seed"), _fitted, geometry_steps.fit, ("4-fit/*",),
        "geometry",
    ),
    SessionStep(
        "validate", "hold it against unseen poses", ("robot", "instrument", "poses", "fit", "seed"), _validated,
        geometry_steps.validate,
        ("5-validation/*",), "geometry",
    ),
    SessionStep(
        "excite", "design the motions to record", (*_keys(PLAN), "seed"), _excited, dynamics_steps.excite,
        ("6-excitation/*/*",), "dynamics",
    ),
    SessionStep(
        "record", "check what was recorded", _keys("plan repeats torques options payloads holdout"), _recorded,
        dynamics_steps.record, (MOTION_CHECKED, CUTS), "dynamics",
    ),
    SessionStep(
        "identify", "identify the dynamics", (*_keys(MODEL), "seed"), _identified, dynamics_steps.identify,
        ("8-dynamics/*",), "dynamics",
    ),
    SessionStep(
        "predict", "hold it against unseen motion",
        (*_keys(f"plan validation repeats tolerance_percent {MODEL}"), "seed"), _predicted, dynamics_steps.predict,
        ("8-dynamics/unseen/*",), "dynamics",
    ),
    SessionStep(
        "export", "write the calibrated robot", ("robot",), _exported, geometry_steps.export,
        ("6-export/*", "9-export/*", VERDICT),
    ),
    SessionStep(
        "certificate", "print the certificate",
        ("name", "created", "instrument", "poses", "fit", *_keys("torques payloads tolerance_percent")), _certified,
        certificate.certify, (CERTIFICATE,),
    ),
)  # fmt: skip
