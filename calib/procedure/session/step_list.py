"""The steps of a session as a table: what each reads, its settings, what it makes and what people bring to it."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from calib.folders import CERTIFICATE
from calib.procedure.excitation.coefficients import NAME as MOTION
from calib.procedure.session import certificate, dynamics_steps, geometry_steps
from calib.procedure.session.folder import (
    AS_GIVEN,
    BROUGHT,
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
FOLDERS = {"geometry": ("2-", "3-", "4-", "5-", "export/"), "dynamics": ("6-", "7-", "8-")}  # of one stage alone


@dataclass(frozen=True)
class SessionStep:
    """One step.

    Attributes:
        name, purpose: for people.
        make: runs it; returns what is to be said.
        reads: the files it reads, by names between blanks: of the session, with ``?`` where one may be missing;
            ``fit/`` and ``export/`` stand for the folders of this session; ``poses:constraints``: what that key of
            ``session.toml`` names; ``measured`` …: what people brought (`BROUGHT`).
        makes: names or patterns of what it makes.
        settings: sections of ``session.toml`` it depends on, or keys of one (``dynamics.period,rate``).
        stage: ``geometry`` or ``dynamics``, where only sessions with that have it.
        brings: what people bring before it, and in words.
        kept: what it is not made again for, once that is brought, and in words; empty: always made again.
    """

    name: str
    purpose: str
    make: Callable[[Session, Say], list[str]]
    reads: str
    makes: str
    settings: str
    stage: str = ""
    brings: tuple[str, str] = ("", "")
    kept: tuple[tuple[str, ...], str] = ((), "")

    def inputs(self, session: Session) -> dict[Path, bool]:
        """Return the files the step reads, and whether each may be missing."""
        names = self.reads.split()
        return {path: name.endswith("?") for name in names for path in _paths(session, name.rstrip("?"))}

    def waits(self, session: Session) -> str:
        """Say which of people's files the step waits for; empty where it waits for none."""
        kind, words = self.brings
        poses, dynamics = session.settings.poses, session.settings.dynamics
        holdouts = {"validation": (poses, session.settings.fit), "unseen": (dynamics, dynamics)}
        if kind in holdouts:
            planned, judged = holdouts[kind]
            if not planned.validation or judged.holdout:
                return ""
        return "" if not kind or session.brought(kind) else words


def _paths(session: Session, name: str) -> Iterator[Path]:
    """Yield the files behind a name that a step reads."""
    left_out = () if session.geometric else FOLDERS["geometry"]
    left_out += () if session.dynamic else FOLDERS["dynamics"]
    if name in BROUGHT:
        yield from session.files_brought(name)
    elif name.startswith("fit/"):
        yield session.fit.path / name.removeprefix("fit/")
    elif ":" in name:
        section, key = name.split(":")
        if named := getattr(getattr(session.settings, section), key):
            yield session.path(named)
    elif not name.startswith(left_out) and not (name == VERDICT and session.geometric):
        yield session.path(name.replace("export/", f"{session.export}/"))


MODEL = "torques,friction,method,options,payloads,holdout"
STEPS = (
    SessionStep(
        "describe", "read the robot", geometry_steps.describe, "robot:file", f"{SUMMARY} {AS_GIVEN}/*", "robot"
    ),
    SessionStep(
        "select", "choose the poses to measure", geometry_steps.select, "robot:file poses:constraints",
        f"2-poses/{POSES} 2-poses/{WAYS} 2-poses/{UNSEEN} {SELECTION} {PREDICTED} {PREDICTION}",
        "robot instrument poses seed", "geometry",
        kept=(("measured",), "files were measured to it (calib redo select: new poses)"),
    ),
    SessionStep(
        "measure", "check what was measured", geometry_steps.arrive,
        f"robot:file 2-poses/{POSES}? fit:options measured drift", POSES_CHECKED, "robot instrument poses fit",
        "geometry", ("measured", "a file of measured poses"),
    ),
    SessionStep(
        "fit", "fit the geometry", geometry_steps.fit, "robot:file fit:options measured", "4-fit/*",
        "robot instrument fit seed", "geometry",
    ),
    SessionStep(
        "validate", "judge it on unseen poses", geometry_steps.validate,
        f"fit/robot.toml fit/report.json 2-poses/{UNSEEN}? fit:options validation", "5-validation/*",
        "robot instrument poses fit seed", "geometry", ("validation", "a file of measured validation poses"),
    ),
    SessionStep(
        "excite", "design the motions to record", dynamics_steps.excite, "fit/robot.toml dynamics:limits",
        "6-excitation/*/*", "dynamics.plan,validation,period,harmonics,rate,starts,evaluations,limits seed", "dynamics",
        kept=(("training", "unseen"), "files were recorded to it (calib redo excite: new motions)"),
    ),
    SessionStep(
        "record", "check what was recorded", dynamics_steps.record,
        f"fit/robot.toml 6-excitation/training/{MOTION}? dynamics:options training", f"{MOTION_CHECKED} {CUTS}",
        "dynamics.plan,repeats,torques,options,payloads,holdout", "dynamics",
        ("training", "a recording of the training motion"),
    ),
    SessionStep(
        "identify", "identify the dynamics", dynamics_steps.identify,
        f"fit/robot.toml {CUTS} dynamics:options training", "8-dynamics/*", f"dynamics.{MODEL} seed", "dynamics",
    ),
    SessionStep(
        "predict", "judge it on unseen motion", dynamics_steps.predict,
        "8-dynamics/robot.toml 8-dynamics/dynamics.json 8-dynamics/metrics.json "
        f"6-excitation/validation/{MOTION}? {CUTS} dynamics:options training unseen",
        "8-dynamics/unseen/*", f"dynamics.plan,validation,repeats,tolerance_percent,{MODEL} seed", "dynamics",
        ("unseen", "a recording of the validation motion"),
    ),
    SessionStep(
        "export", "write the calibrated robot", geometry_steps.export,
        "robot:file fit/robot.toml 4-fit/robot.urdf 5-validation/metrics.json 8-dynamics/dynamics.json "
        "8-dynamics/estimate.csv 8-dynamics/covariance.csv 8-dynamics/unseen/report.json",
        f"6-export/* 9-export/* {VERDICT}", "robot",
    ),
    SessionStep(
        "certificate", "print the certificate", certificate.certify,
        f"{VERDICT} 4-fit/report.json 5-validation/metrics.json export/robot.urdf {SELECTION}? {POSES_CHECKED} "
        f"{MOTION_CHECKED} 8-dynamics/metrics.json 8-dynamics/estimate.csv 8-dynamics/unseen/report.json {MARK}?",
        CERTIFICATE, "name created instrument poses fit dynamics.torques,payloads,tolerance_percent",
    ),
)  # fmt: skip
