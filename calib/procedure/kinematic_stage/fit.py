"""The fit as the guided procedure runs it: climb the models, judge on unseen rows, say what came of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calib.data.poses.fit_options import FitOptions
from calib.data.poses.measurements import PoseMeasurements
from calib.errors import NotConverged
from calib.geometry.accuracy import errors
from calib.geometry.checks.diagnosis import diagnose
from calib.geometry.checks.explanation import explain
from calib.geometry.first_guess import install
from calib.geometry.fit import fit, polish_frames
from calib.geometry.installation import Installation
from calib.geometry.model_choice.folds import folds_by_name
from calib.geometry.model_choice.ladder import Climb, climb
from calib.geometry.observation import has_instrument
from calib.geometry.parameters import layout
from calib.geometry.result import GeometricFit, calibrated_chain
from calib.geometry.weighing import Settings, combine
from calib.procedure.kinematic_stage.inputs import Inputs
from calib.procedure.kinematic_stage.outliers import Outlier, named_outliers, plateau, remains
from calib.procedure.kinematic_stage.proof import doubtful
from calib.procedure.kinematic_stage.validation import (
    Comparison,
    compare,
    compare_unseen,
    urdf_alone,
    without_corrections,
)
from calib.procedure.kinematic_stage.verdict import OWN_FRAMES, Verdict, judge
from calib.robot.calibrated import CalibratedChain
from calib.robot.chain import Chain
from calib.robot.deflection import Deflection

Progress = Callable[[str], None]
MOVED = 3.0  # nominal errors fall by this factor when each file gets a station of its own: it was moved (our choice)
ELSEWHERE = 20.0  # nominal errors this many times the fit's: the instrument must have stood elsewhere (our choice)


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a fit came to.

    Attributes:
        inputs: what it worked on.
        climb: the rungs, the chosen model, and the fits of the nominal and the calibrated arm.
        rigid: the best fit without joint corrections: the geometry that a URDF holds and dynamics is identified on.
        fit: the two arms on the fit rows.
        validation: the two arms on unseen rows, by file name.
        outliers: rows of the fit that do not fit, worst first.
        unclear: what the data cannot tell, in words.
        warnings: what a user should know.
        verdict: pass, marginal or fail, with its reason.
        seed: that reproduces it.
        tolerance: largest rms on unseen poses that is good enough [m]; None where none was given.
        said: those warnings that the fit alone gives, whatever the unseen rows are.
    """

    inputs: Inputs
    climb: Climb
    rigid: GeometricFit
    fit: Comparison
    validation: Mapping[str, Comparison]
    outliers: Sequence[Outlier]
    unclear: tuple[str, ...]
    warnings: tuple[str, ...]
    verdict: Verdict
    seed: int = 0
    tolerance: float | None = None
    said: tuple[str, ...] = ()

    @property
    def calibrated(self) -> CalibratedChain:
        """The calibrated robot, for all that goes on from here."""
        found = calibrated_chain(self.climb.fit, self.rigid, self.inputs.nominal)
        return replace(found, source=str(self.inputs.source))


@dataclass(frozen=True, eq=False)
class Assessment:
    """Both arms on the same rows, and what that comes to.

    Attributes:
        fit: on the fit's rows.
        validation: on unseen rows, by file name.
        verdict: pass, marginal or fail, with its reason.
        warnings: what a user should know, of the inputs, the fit and the unseen rows.
    """

    fit: Comparison
    validation: Mapping[str, Comparison]
    verdict: Verdict
    warnings: tuple[str, ...]


def run(
    inputs: Inputs,
    options: FitOptions | None = None,
    *,
    model: str | None = None,
    loss: str | None = None,
    tolerance: float | None = None,
    folds: str = "transfer",
    seed: int = 0,
    progress: Progress | None = None,
) -> Outcome:
    """Fit, compare on all rows, and judge.

    Args:
        inputs: see `calib.procedure.kinematic_stage.inputs.gather`.
        options: the fit options file's content.
        model, loss: in place of the options'.
        tolerance: largest rms on unseen poses that is good enough [m].
        folds: how the ladder sets rows aside, see `calib.geometry.model_choice.folds.folds_by_name`.
        seed: for everything random.
        progress: called with a few words at each stage.

    Raises:
        NotConverged: where the chosen model's fit did not come to an end.
    """
    options, say = options or FitOptions(), progress or (lambda words: None)
    settings = combine(Settings(), loss=loss or options.loss, loss_scale=options.loss_scale)
    asked = model or options.model
    say("placing the instrument and the tool")
    start = install(inputs.chain, inputs.fit, inputs.known)
    torques = [gravity_of(inputs.chain, block) for block in inputs.fit]
    found = climb(
        start,
        inputs.fit,
        asked,
        settings=settings,
        torques=torques,
        fixed=fixed_parameters(start, options),
        prior=stated_prior(start, options),
        folds=folds_by_name(folds, inputs.fit, seed),
        seed=seed,
        progress=lambda done, total, what: say(f"fitting: {what}"),
    )
    status = found.fit.solution.status
    if not status.good:
        raise NotConverged(f"the fit of model '{found.chosen}' did not converge: {status.value}", found.fit)
    say("comparing on unseen poses")
    rigid = rigid_fit(found, inputs.fit, settings)
    named = named_outliers(found.fit)
    known = judged(inputs, found, named)
    unexplained = plateau(found, known["reach"])
    said = (
        *moved_between(found.nominal.cell, inputs.fit, settings), *((unexplained,) if unexplained else ()),
        *diagnose(found.fit),
    )  # fmt: skip
    both = found.nominal.cell, found.fit.cell
    result = assess(*both, rigid.cell.chain, inputs, settings, known, said, asked=asked, tolerance=tolerance, seed=seed)
    return Outcome(
        inputs, found, rigid, result.fit, result.validation, named, tuple(explain(found.fit)), result.warnings,
        result.verdict, seed, tolerance, said,
    )  # fmt: skip


def assess(
    nominal: Installation,
    calibrated: Installation,
    rigid: Chain,
    inputs: Inputs,
    settings: Settings,
    known: Mapping[str, Any],
    said: Sequence[str],
    *,
    asked: str,
    tolerance: float | None = None,
    seed: int = 0,
) -> Assessment:
    """Compare both arms on fitted and on unseen rows, and judge: in the command, and of a fit read from its folder.

    Args:
        nominal, calibrated: installations, frames fitted to the fit's rows.
        rigid: the best geometry without joint corrections.
        inputs: the rows.
        settings: of the fit, as asked for.
        known: what `judged` says of the fit.
        said: what the fit says of itself (`Outcome.said`).
        asked: the model asked for.
        tolerance: largest rms on unseen poses that is good enough [m].
        seed: of the pairs whose distances are compared.
    """
    torques = [gravity_of(inputs.chain, block) for block in inputs.fit]
    alone = without_corrections(calibrated, rigid, inputs.fit, settings)
    fitted = compare(nominal, calibrated, inputs.fit, torques, "fitted on these rows", False, seed, alone=alone)
    validation = {
        name: compare_unseen(nominal, calibrated, unseen, lambda b: gravity_of(inputs.chain, b), settings, seed, alone)
        for name, unseen in inputs.unseen.items()
    }
    verdict = judge(fitted, validation, asked=asked, tolerance=tolerance, **known)
    clause, loud = urdf_alone(fitted, validation)
    verdict = verdict if not clause else replace(verdict, reason=f"{verdict.reason}; {clause}")
    blocks = (*inputs.fit, *(unseen.block for unseen in inputs.unseen.values()))
    warnings = (
        *loud, *inputs.notes, *(note for block in blocks for note in block.notes), *elsewhere(fitted, validation),
        *said, *doubtful(validation),
    )  # fmt: skip
    return Assessment(fitted, validation, verdict, tuple(dict.fromkeys(warnings)))


def rigid_fit(found: Climb, measured: Sequence[PoseMeasurements], settings: Settings) -> GeometricFit:
    """Return the best fit without any corrections, those that came with the robot included: for a URDF."""
    if not found.rigid.cell.known.terms:
        return found.rigid
    bare = polish_frames(replace(found.nominal.cell, known=Deflection()), measured, settings).cell
    drawn = not all(has_instrument(block) for block in measured)
    table = layout(bare)
    every = np.concatenate([table.arm_index, table.frame_index])
    return fit(bare, measured, every, settings=settings, drawn=drawn)


def judged(inputs: Inputs, found: Climb, named: Sequence[Outlier]) -> dict[str, Any]:
    """Return what `judge` of the verdict needs besides errors, the model asked for and a tolerance."""
    long = reach(inputs.chain)
    return {
        "model": found.chosen,
        "cross_validated": cross_validated(found),
        "nominal_cross_validated": next((r.cross_validated for r in found.rungs if r.model == "frames"), None),
        "outlier_share": len({(each.file, each.row) for each in named}) / sum(len(block) for block in inputs.fit),
        "unexplained": plateau(found, long) if remains(found, long) else "",
        "reach": long,
    }


def fixed_parameters(start: Installation, options: FitOptions) -> np.ndarray:
    """Return the positions of parameters that stay at their nominal: those in ``fix``, or all but those in ``free``.

    ``free`` speaks of the arm; frames are always fitted.
    """
    table = layout(start)
    fixed = table.find(options.fix)
    if options.free:
        fixed = np.union1d(fixed, np.setdiff1d(table.arm_index, table.find(options.free)))
    return fixed


def stated_prior(start: Installation, options: FitOptions) -> np.ndarray | None:
    """Return the standard deviations of the parameter vector that the options state; infinite elsewhere."""
    if not options.prior:
        return None
    table = layout(start)
    prior = np.full(len(table.names), np.inf)
    prior[table.find(tuple(options.prior))] = list(options.prior.values())
    return prior


def cross_validated(found: Climb) -> float:
    """Return the error of the chosen model on rows left out [m]: that of the last rung kept."""
    return [rung.cross_validated for rung in found.rungs if rung.kept][-1]


def gravity_of(chain: Chain, block: PoseMeasurements) -> np.ndarray | None:
    """Return gravity torques (m, n) [N m] of a block; None where the robot's masses are not known."""
    if chain.inertias is None or sum(element.joint is not None for element in chain.elements) != chain.n:
        return None
    from calib.dynamics.gravity import gravity_torques

    return gravity_torques(chain, block.q)


def reach(chain: Chain) -> float:
    """Return how long the stretched arm is at most [m]: the sum of its constant offsets."""
    total = sum(abs(e.value) for e in chain.elements if e.axis[0] == "t" and e.joint is None)
    placed = sum(float(np.linalg.norm(e.placement[:3, 3])) for e in chain.elements if e.placement is not None)
    return max(total + placed + float(np.linalg.norm(chain.tail[:3, 3])), 0.1)


def elsewhere(fit: Comparison, validation: Mapping[str, Comparison]) -> list[str]:
    """Name validation files whose errors look like another placement of the instrument, not like an arm's."""
    usual = float(np.median(fit.errors[0].main)) if len(fit.errors[0].main) else np.inf
    return [
        f"{name}: nominal errors of {1e3 * np.median(found.errors[0].main):.3g} mm look like an instrument (or "
        f"tool) that stood elsewhere; give {OWN_FRAMES}"
        for name, found in validation.items()
        if np.median(found.errors[0].main) > ELSEWHERE * usual
    ]


def moved_between(nominal: Installation, blocks: Sequence[PoseMeasurements], settings: Settings) -> list[str]:
    """Say that several files share one station where stations of their own explain them far better."""
    own = [block for block in blocks if has_instrument(block)]
    if len({block.file for block in own}) < 2 or len({block.station for block in own}) > 1:
        return []
    apart = [replace(block, station=f"{number}") for number, block in enumerate(own)]
    torques = [gravity_of(nominal.chain, block) for block in own]
    before = _rms(nominal, own, torques)
    placed = polish_frames(install(nominal.chain, apart, nominal.known), apart, settings, torques).cell
    after = _rms(placed, apart, torques)
    if before < MOVED * after:
        return []
    return [
        f"with one station for all {len(own)} files the nominal arm is off by {1e3 * before:.3g} mm rms, with one for "
        f"each by {1e3 * after:.3g} mm: the instrument seems to have been moved; give --stations each (in a "
        'session: stations = "each" in session.toml)'
    ]


def _rms(cell: Installation, blocks: Sequence[PoseMeasurements], torques: list[np.ndarray | None]) -> float:
    return float(np.sqrt(np.mean(errors(cell, blocks, torques).main ** 2)))
