"""Steps of a session for geometry and export, which call the functions of `calib fit` and `calib export`.

A session asks for two sets of poses: optimised ones for the fit, and random ones for validation.
"""

import shutil
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from calib import files
from calib.data.images.coverage import image_words
from calib.data.poses import IMAGES
from calib.data.poses.fit_options import FileOptions, FitOptions, read_options
from calib.data.poses.measurements import PoseMeasurements, Poses, Positions
from calib.data.poses.pose_lists import (
    MAX_JOINT_DIFFERENCE,
    check_against,
    filled_in,
    read_poses,
    unmeasured,
    write_poses,
)
from calib.data.schema import Joints
from calib.errors import CalibError, Finding, UsageError, finding
from calib.extensions import Point
from calib.folders import write_staged
from calib.geometry.observability import SIGMA_ORIENTATION, observation, targets_of
from calib.identification.model_file import MODEL
from calib.procedure.findings import UNJUDGED, Warned, lines_of
from calib.procedure.kinematic_stage import fit as fitting
from calib.procedure.kinematic_stage import folder as outputs
from calib.procedure.kinematic_stage import inputs, selection
from calib.procedure.kinematic_stage.settings import FitSettings, SelectionSettings
from calib.procedure.kinematic_stage.validation import assess
from calib.procedure.measuring.constraints_file import VIEW_UNCHECKED
from calib.procedure.measuring.pose_limits import read_limits
from calib.procedure.measuring.prediction import beside
from calib.procedure.measuring.prediction import read as read_prediction
from calib.procedure.measuring.prediction import write as write_prediction
from calib.procedure.measuring.run import same_turn, write_run
from calib.procedure.report import fit_report
from calib.procedure.report.geometry_section import error_words, outlier_sentences, parameter_words
from calib.procedure.report.outputs import write_fit
from calib.procedure.session import drift, folder
from calib.procedure.session.folder import Say, Session
from calib.robot import calibrated
from calib.robot.chain import Chain, joint_kinds
from calib.robot.formats.urdf_tree import is_urdf
from calib.robot.library import load_calibrated
from calib.units import JOINT
from poses.candidates import draw_candidates
from poses.space import is_feasible

WRITE_PROGRAM: Point[Callable[[Path, Path, str], Any]] = Point(
    "write_program", "files of a program of the poses in a CSV"
)

HOW = "add [camera] to the limits file, see `calib formats constraints`"


def _choose(session: Session, chain: Chain, say: Say) -> list[str]:
    """Choose poses as set in ``session.toml``; write the poses, the driving order, and the predicted sigmas."""
    settings, robot_file = session.settings, session.robot_file
    section, instrument = settings.poses, settings.instrument
    sigmas = (instrument.sigma_position, instrument.sigma_orientation or SIGMA_ORIENTATION)
    choice = SelectionSettings(
        kind=_seen_as(instrument.measures),
        tools=(instrument.tool,),
        index=section.index,
        method=section.method,
        sigmas=sigmas if instrument.sigma_position else None,
        seed=settings.seed,
    )
    chosen = selection.choose(
        robot_file,
        section.fit,
        choice,
        constraints=session.named(section.constraints),
        **session.links,
        progress=lambda done, total, what: say(f"choosing poses: {what}"),
    )
    said = any(words.startswith(VIEW_UNCHECKED) for words in chosen.unchecked)
    if instrument.measures == IMAGES and not chosen.by_images and not said:
        chosen = replace(chosen, unchecked=(*chosen.unchecked, f"{VIEW_UNCHECKED} ({HOW})"))
    found, q = chosen.selection, chosen.selection.joints
    if found.interrupted:  # a session is resumed, not gone on with half a search
        raise KeyboardInterrupt
    gain = found.random_baseline / found.value if found.index == "cond" else found.value / found.random_baseline
    words = (
        f"{len(q)} poses by {found.method}, {found.index} = {found.value:.4g}, {gain:.2f} times the best of 1000 "
        f"random sets, {100 * found.efficiency:.1f} % of the convex bound ({selection.bound_words(found)})"
    )
    unseen = _unseen(session, robot_file, chain, section.validation)
    sets = {folder.POSES: q, folder.UNSEEN: unseen} if section.validation else {folder.POSES: q}
    for name, joints in sets.items():
        path = write_poses(session.path(f"2-poses/{name}"), joints, chain.joint_names, joint_kinds(chain))
        if settings.robot.controller:
            WRITE_PROGRAM.one()(path, path.with_suffix(""), settings.robot.controller)
    write_run(session.path(f"2-poses/{folder.WAYS}"), chosen.run, chain)
    if chosen.prediction is not None:
        write_prediction(chosen.prediction, session.path(f"2-poses/{folder.POSES}"))
    outlook = chosen.outlook.poses
    if session.plots and np.isfinite(outlook.rms):
        from calib.procedure.report.charts import picture
        from calib.procedure.report.geometry_figures import predicted_map

        chart = predicted_map(outlook.points, outlook.spread)
        files.write(session.path(folder.PREDICTED), picture(chart, "").image)
    record = {"words": words, **selection.record(chosen), "seed": settings.seed}
    files.write_json(session.path(folder.SELECTION), record)
    notes = [f"{len(q)} poses for the fit: {words}"]
    notes += [f"{len(unseen)} random poses for validation"] if section.validation else []
    numbers = (f"{words}: {number}" for words, number in selection.predicted_rows(chosen))
    return [*notes, *chosen.kept(), *numbers, *record["notes"]]


def _seen_as(measures: str) -> str:
    """Return the kind of measurement for pose selection; an image counts as a pose."""
    return "pose" if measures == IMAGES else measures


def _unseen(session: Session, robot_file: Any, chain: Chain, count: int) -> np.ndarray:
    """Return random poses (count, n) within all limits, independent of the poses chosen for the fit."""
    if not count:
        return np.zeros((0, chain.n))
    cell = targets_of(chain, [session.settings.instrument.tool])
    limits = read_limits(session.named(session.settings.poses.constraints), cell, robot_file)
    jacobian = observation(cell, _seen_as(session.settings.instrument.measures))
    space = limits.space(jacobian)
    stream = np.random.default_rng([session.settings.seed, 1])
    if limits.camera is not None:
        return limits.camera.draw(count, partial(is_feasible, space), limits.lower, limits.upper, stream)
    q = draw_candidates(limits.lower, limits.upper, count, lambda q: is_feasible(space, q), seed=stream)
    return same_turn(chain, q, limits.lower, limits.upper)


MIN_READBACK_DIFFERENCE = 1e-8  # [rad or m] closer to the commanded joints they were not read back


def chain_of(session: Session) -> Chain:
    """Return the nominal arm of the session's robot."""
    return inputs.load_robot(session.robot_file, None, _options_of(session), **session.links)[0]


def _options_of(session: Session, paths: Sequence[Path] = ()) -> FitOptions:
    """Return the fit options; files without a sigma get the instrument's, those (`paths`) without joints the plan's."""
    instrument, unseen = session.settings.instrument, session.brought("validation")
    options = read_options(session.named(session.settings.fit.options))
    position, turn = instrument.sigma_position, instrument.sigma_orientation

    def stated(each: FileOptions) -> FileOptions:
        sigma = each.sigma
        if position and sigma.position is None:
            sigma = replace(sigma, position=(position,) * 3)
        if turn and sigma.orientation is None:
            sigma = replace(sigma, orientation=(turn,) * 3)
        return replace(each, sigma=sigma)

    lists = {path: session.path(f"2-poses/{folder.UNSEEN if path in unseen else folder.POSES}") for path in paths}
    there = {path: plan for path, plan in lists.items() if session.settings.poses.plan and plan.exists()}
    own = {path.name: replace(options.for_file(path), planned=str(plan)) for path, plan in there.items()}
    files = {name: stated(each) for name, each in {**options.files, **own}.items()}
    return replace(options, sigma=stated(options).sigma, files=files)


def describe(session: Session, say: Say) -> list[str]:
    """Read the robot, write a summary of it, and return notes."""
    chain = chain_of(session)
    lines = [f"{chain.name}: {chain.base} to {chain.tip}, {chain.n} joints, {len(chain.elements)} elements", ""]
    for joint in chain.joints:
        factor, unit = JOINT[joint.kind]
        lines.append(f"{joint.name}: {joint.kind}, {factor * joint.lower:g} to {factor * joint.upper:g} {unit}")
    lines += ["", "elements, base to tip [m, rad]"]
    lines += [f"  {element.name:<24} {element.axis}  {element.value:.9g}" for element in chain.elements]
    files.write(session.path(folder.SUMMARY), "\n".join(lines) + "\n")
    if session.geometric:
        return [lines[0]]
    known = load_calibrated(session.robot_file, **session.links)
    session.fit.path.mkdir(exist_ok=True)
    calibrated.write(session.fit.path, replace(known, nominal=known.nominal or known.chain))
    return [lines[0], "nothing is measured: the geometry of the robot's file is used"]


def select(session: Session, say: Say) -> list[str]:
    """Choose poses for the fit, and random ones for validation, and return notes."""
    chain = chain_of(session)
    for path in (session.path(f"2-poses/{name}") for name in (folder.POSES, folder.UNSEEN)):
        if path.exists() and filled_in(path, chain.n):
            raise UsageError(
                f"{path} contains more than the planned poses and would be overwritten: move measurements to "
                f"{session.path('3-measured')}, and restore or remove this list"
            )
    say("choosing poses")
    return _choose(session, chain, say)


def arrive(session: Session, say: Say) -> list[str]:
    """Check the measured files for the fit, and return notes."""
    chain = chain_of(session)
    blocks, again = (read_measured(session, chain, session.brought(kind)) for kind in ("measured", "drift"))
    notes = notes_on(session, chain, blocks, folder.POSES)
    notes += lines_of(drift.of_session(session, chain, *([block for _, block in own] for own in (blocks, again))))
    files.write(session.path(folder.POSES_CHECKED), "\n".join(notes) + "\n")
    return notes


def read_measured(
    session: Session, chain: Chain, paths: Sequence[Path], like: Sequence[PoseMeasurements] = ()
) -> list[tuple[str, PoseMeasurements]]:
    """Return the blocks of measured files with their files' names.

    Raises:
        MeasurementError: for implausible values, with row and column.
    """
    options = _options_of(session, paths)
    return [(path.name, block) for path in paths for block in inputs.read_file(path, chain, options, like)]


def notes_on(session: Session, chain: Chain, blocks: Sequence[tuple[str, PoseMeasurements]], plan: str) -> list[str]:
    """Return the notes on measured blocks: rows, kind, ignored columns, poses missing from a list in ``2-poses``."""
    measures, notes, path = session.settings.instrument.measures, [], session.path(f"2-poses/{plan}")
    planned = None
    if session.settings.poses.plan and path.exists():
        planned = read_poses(path, Joints(chain.joint_names, joint_kinds(chain)))
    for name, block in blocks:
        ignored = f", ignored: {', '.join(block.ignored)}" if block.ignored else ""
        found = [f"{len(block)} rows of kind {block.kind}{ignored}"]
        if measures == Poses.kind and isinstance(block, Positions) and not isinstance(block, Poses):
            found.append("only positions, although the instrument measures poses")
        if block.kind == IMAGES:
            found.append(image_words(block))
        elif measures == IMAGES:
            found.append("contains no images, although the instrument is a camera; the file is fitted nevertheless")
        found += block.notes
        if planned is not None:
            found += [*check_against(planned, block), *lines_of(readback(planned, block))]
        notes += [(Warned if isinstance(note, Warned) else str)(f"{name}: {note}") for note in found]
    return notes if planned is None else [*notes, *unmeasured(planned, [block for _, block in blocks])]


def readback(plan: np.ndarray, measured: PoseMeasurements) -> list[Finding]:
    """Return findings on measured minus planned joint values (m, n) [rad or m]; empty if no pose was planned."""
    distance, index = (np.atleast_1d(found) for found in KDTree(plan).query(measured.q, p=np.inf))
    close = distance <= MAX_JOINT_DIFFERENCE
    if not close.any():
        return []
    off = np.abs(measured.q[close] - plan[index[close]])
    if off.max() < MIN_READBACK_DIFFERENCE:
        return [finding("readback-copied")]
    joint = measured.joint_names[int(np.argmax(off.max(axis=0)))]
    return [finding("readback", rms=np.sqrt(np.mean(off**2)), largest=off.max(), joint=joint)]


def _fit_settings(session: Session) -> FitSettings:
    """Return the fit settings of ``session.toml``; a value ``auto`` leaves the choice to the options file."""
    section, masses = session.settings.fit, session.path(folder.MASSES)
    model, loss = (None if value == "auto" else value for value in (section.model, section.loss))
    return FitSettings(
        model=model,
        loss=loss,
        stations=section.stations,
        tolerance=1e-3 * section.tolerance_mm or None,
        refit_frames=section.validation_frames == "own",
        seed=session.settings.seed,
        holdout=section.holdout,
        deliverable=section.deliverable,
        masses=str(masses) if (masses / MODEL).is_file() else "",
    )


def _gathered(session: Session, validate: Sequence[Path] = ()) -> inputs.Inputs:
    """Return the inputs of the fit: robot, measurements, and the given validation files."""
    chain, links, measured = chain_of(session), session.links, session.brought("measured")
    if is_urdf(session.robot_file):  # whatever joints the files' columns name
        links = {"base": chain.base, "tip": chain.tip}
    return inputs.gather(
        session.robot_file,
        measured,
        validate,
        options=_options_of(session, [*measured, *validate]),
        settings=_fit_settings(session),
        **links,
    )


def fit(session: Session, say: Say) -> list[str]:
    """Fit the geometry to the measured files; validation files are not used."""
    poses = session.path(f"2-poses/{folder.POSES}")
    selection = read_prediction(poses) if session.settings.poses.plan and beside(poses).exists() else None
    outcome = fitting.run(_gathered(session), _options_of(session), _fit_settings(session), say, selection)
    outcome = replace(outcome, assessment=replace(outcome.assessment, verdict=UNJUDGED, deliverables={}))
    draw = partial(write_fit, plots=session.plots, pages=False)
    outputs.write_folder(outcome, session.fit.path, draw, owned=True)
    metrics = session.fit.metrics()
    words = f"model {metrics.model}: {error_words(metrics)}; {parameter_words(metrics)}"
    advice = () if outcome.selection.loss != "none" else ('check these rows, or set loss = "cauchy" in session.toml',)
    outliers = ["; ".join((line, *advice)) for line in outlier_sentences(metrics)]
    return [words, *outcome.warnings, *outliers]


def validate(session: Session, say: Say) -> list[str]:
    """Validate the fitted robot on unseen poses, as `calib fit` does with validation files."""
    chain, unseen, fit, out = chain_of(session), session.brought("validation"), session.fit, session.validation
    before, report = fit.metrics(), fit_report.read(fit.report)
    like = _gathered(session).fit if any(path.is_dir() for path in unseen) else ()
    notes = notes_on(session, chain, read_measured(session, chain, unseen, like), folder.UNSEEN)
    say("comparing on unseen poses")
    given, options, wanted = _gathered(session, unseen), _options_of(session), _fit_settings(session)
    settings = fitting.weighing_settings(options, wanted)
    asked = replace(wanted, model=wanted.model or options.model)
    found = assess(fit.arms(given, settings), given, fit.findings(), settings, asked)
    rows = [fit_report.rows_of(name, each, each.proves) for name, each in found.validation.items()]
    written = out.write(found, given, rows)
    fit_report.write(report.with_unseen(written, rows), out.report)
    fresh = [words for words in found.warnings if words not in before.warnings]
    return [*notes, str(found.verdict), *fresh]


def export(session: Session, say: Say) -> list[str]:
    """Export the calibrated robot to all formats, and write a verdict on each file and on the session."""
    from calib.procedure.export.delivery import by_file, mark, prediction

    out = session.path(session.export)
    lines = _exported(session, out, say)
    found = session.verdicts()
    judged = {name: one.table() for name, one in by_file(out, found).items() if one.level}
    whole = {"schema": 1, **found.table(), "deliverable": session.settings.fit.deliverable, "files": judged}
    known = prediction(out)
    files.write_json(session.path(folder.VERDICT), whole | {"exported_prediction": known and asdict(known)})
    return [*mark(out, found), *lines]


def _exported(session: Session, out: Path, say: Say) -> list[str]:
    from calib.procedure.export.delivery import FILES, Export, deliver

    if not session.geometric:
        write_staged(out, [file.name for file in FILES], partial(shutil.copy, session.fit.robot))
    if not session.dynamic:
        return deliver(Export(session.robot_file, session.fit.path), out)
    say("physically consistent parameters")
    for name in FILES:  # a second robot.urdf, by earlier versions
        (out / "dynamics" / name.name).unlink(missing_ok=True)
    with suppress(OSError):  # not there, or not empty
        (out / "dynamics").rmdir()
    whole = Export(session.robot_file, session.fit.path if session.geometric else None, session.identification.path)
    try:
        return deliver(whole, out)
    except CalibError as error:  # the geometry stands by itself
        alone = deliver(replace(whole, identified=None), out) if session.geometric else [calibrated.ROBOT]
        return [*alone, f"the dynamics were not exported: {error}"]


def clear_staging(session: Session) -> None:
    """Remove the temporary folders of a killed command; an upload that arrives meanwhile stays."""
    for path in session.folder.rglob(".*.part"):
        if files.in_use(path):
            continue
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
