"""Model selection: which joint corrections are added to the geometry, decided by errors on rows that were not fitted.

    geometry → + one effect → + one more … (their names: `calib.data.poses.MODELS`)

An effect is a family of deflection terms (joint corrections as functions of q), such as compliance or gear errors. The
sequence of models is called the ladder. The rigid geometry is not selected: it is the most probable one under priors of
making (`calib.geometry.fit`), or only the placements or joint offsets where the user asks for these. The effect that
reduces the error on held-out rows (`calib.geometry.model_choice.folds`) most is added. Then the effect that reduces the
remaining error most is added, until no effect reduces it enough. One effect may be visible only after another was
added: compliance, for example, only after gear errors.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.data.poses import MODELS as CHOICES
from calib.data.poses.measurements import PoseMeasurements, Positions
from calib.errors import UsageError, one_of
from calib.geometry.fit import fit, fit_with_prior, polish_frames
from calib.geometry.installation import Installation
from calib.geometry.model_choice.cross_validation import (
    HARMONIC,
    FoldStatistics,
    UnseenErrors,
    blind_folds,
    fold_statistics,
    with_terms,
)
from calib.geometry.model_choice.folds import Folds, divide, transfer_folds
from calib.geometry.model_choice.stated_compliance import StatedCompliance
from calib.geometry.observation import layout, prepare
from calib.geometry.weighing import GeometricFit, Settings
from calib.robot.calibrated import Deflection, Term
from calib.robot.chain import Chain

# smallest relative reduction of the error on held-out rows by an effect that is added (our choice)
MIN_GAIN = 0.03
# number of robust sigmas above which a row is a gross outlier (our choice)
MAX_RESIDUAL = 8.0
# highest orders of harmonics: for a joint's encoder and gear, and for the wobble of its axis
MAX_ORDER = 60
MAX_WOBBLE_ORDER = 2
# harmonics of order k need at least this number of poses times k (our choice)
POSES_PER_ORDER = 8
RIGID_MODELS = ("frames", "offsets", "geometry")
NONE = np.array([], dtype=int)

Progress = Callable[[int, int, str], None]


def _stiffness(chain: Chain, torques_known: bool) -> list[Term]:
    """Return the terms for deflection of each joint under gravity.

    With gravity torques, of each joint about its axis by its torque, and of links and bearings across it by the moment
    of all that they carry; else about its axis by fitted moments.

    Args:
        chain: the arm.
        torques_known: whether gravity torques can be computed from known masses.
    """
    terms: list[Term] = []
    for joint, element in enumerate(chain.moving):
        if torques_known and chain.joints[joint].kind == "revolute":
            terms.append(Term(chain.names[element], "torque", joint))
        elif not torques_known and chain.elements[element].axis[0] == "r":
            terms += _sag(chain, int(element))
    if torques_known and chain.inertias is not None:
        for number in _fixed_elements(chain):
            element = chain.elements[number]
            if element.axis[0] == "r":
                terms.append(Term(element.name, "moment", element.owner))
    return terms


def _bending(chain: Chain, torques_known: bool) -> list[Term]:
    """Return the terms for the tilt of each joint's axis under gravity, due to compliant bearings and links.

    Args:
        chain: the arm.
        torques_known: not used; the interface of all effects.
    """
    terms: list[Term] = []
    for number in _fixed_elements(chain):
        if chain.elements[number].axis[0] == "r":
            terms += _sag(chain, number)
    return terms


def _fixed_elements(chain: Chain) -> list[int]:
    """Return the numbers of chain elements that no joint moves, without those after the last joint."""
    moving = set(chain.moving.tolist())
    return [k for k, element in enumerate(chain.elements) if k not in moving and element.owner < chain.n]


def _sag(chain: Chain, number: int) -> list[Term]:
    """Return the terms for the rotation of an element under the weight of the links it carries, by link and axis.

    Args:
        chain: the arm.
        number: index of the element.
    """
    element = chain.elements[number]
    links = range(element.owner, chain.n)
    return [Term(element.name, "lever", link, axis) for link in links for axis in range(3)]


def _coupling(chain: Chain, torques_known: bool) -> list[Term]:
    """Return the terms for gear ratios and coupled gears: corrections proportional to a joint's value or its
    neighbours'.

    Args:
        chain: the arm.
        torques_known: not used; the interface of all effects.
    """
    terms: list[Term] = []
    for joint in range(chain.n):
        name = chain.names[chain.moving[joint]]
        sources = range(max(joint - 1, 0), min(joint + 2, chain.n))
        terms += [Term(name, "joint", source) for source in sources]
    return terms


def _harmonics(chain: Chain, torques_known: bool) -> list[Term]:
    """Return the terms sin k q_j, cos k q_j, k = 1 … `MAX_ORDER`, of each revolute joint: encoder and gear errors.

    Args:
        chain: the arm.
        torques_known: not used; the interface of all effects.
    """
    terms: list[Term] = []
    for joint, element in enumerate(chain.moving):
        terms += _turning(chain, chain.names[element], joint, MAX_ORDER)
    return terms


def _wobble(chain: Chain, torques_known: bool) -> list[Term]:
    """Return the terms for wobble of each joint's axis: low harmonics of q_j on the other elements of joint j.

    Args:
        chain: the arm.
        torques_known: not used; the interface of all effects.
    """
    terms: list[Term] = []
    for number in _fixed_elements(chain):
        element = chain.elements[number]
        terms += _turning(chain, element.name, element.owner, MAX_WOBBLE_ORDER)
    return terms


def _turning(chain: Chain, name: str, joint: int, max_order: int) -> list[Term]:
    """Return the terms of an element that are harmonics of a revolute joint's angle; empty for a prismatic joint.

    Args:
        chain: the arm.
        name: name of the element that the terms move.
        joint: index of the joint.
        max_order: highest order k of sin k q and cos k q.
    """
    if chain.joints[joint].kind != "revolute":
        return []
    return [Term(name, basis, joint, order) for order in range(1, max_order + 1) for basis in HARMONIC]


MODELS = CHOICES[1:]
FAMILIES = (_stiffness, _bending, _coupling, _harmonics, _wobble)
# the effect that scales with the load
BY_LOAD = MODELS[3]
# effects by name: functions that return the terms for a chain, and for known or unknown gravity torques
EFFECTS: dict[str, Callable[[Chain, bool], list[Term]]] = dict(zip(MODELS[3:], FAMILIES, strict=True))


@dataclass(frozen=True)
class ModelStep:
    """One model tried in the model selection.

    Attributes:
        model: name of the model, e.g. ``geometry`` or ``+ harmonics``.
        parameters: number of fitted parameters.
        cross_validated_mm: rms error on held-out rows [mm]; None in files of earlier versions.
        kept: True where the next models include this step.
        note: reason for not using the effect, in words; empty for a step that is used.
        corrections: number of the parameters that are joint corrections, regularised by a ridge.
    """

    model: str
    parameters: int
    cross_validated_mm: float | None
    kept: bool
    note: str = ""
    corrections: int = 0

    @property
    def cross_validated(self) -> float:
        """Cross-validation error: rms on held-out rows [m]; NaN where it is not known."""
        return np.nan if self.cross_validated_mm is None else 1e-3 * self.cross_validated_mm


@dataclass(frozen=True, eq=False)
class ModelSelection:
    """Result of the model selection.

    Attributes:
        fit: the chosen model, fitted to all rows.
        nominal: the nominal arm with placements fitted to all rows.
        nominal_step: the step of the nominal arm.
        rigid: the best fit to all rows without effects. The geometry in ``fit`` is valid only together with its
            effects, with which it is correlated; without effects (for a URDF), use ``rigid``.
        rungs: all models tried, in order.
        chosen: name of the chosen model, e.g. ``geometry + harmonics``.
        folds: partition of the rows by which rows were held out.
        loss: the robust loss that was used.
        offered: all terms of the chosen effects; ``fit`` contains those of them that the data did not switch off.
        rigid_cross_validated: rms error of the best model without effects on held-out rows [m]; None if it is not
            known.
        reference: chain, with masses, on which the terms' basis functions are evaluated; None for the nominal arm.
    """

    fit: GeometricFit
    nominal: GeometricFit
    nominal_step: ModelStep
    rigid: GeometricFit
    rungs: tuple[ModelStep, ...]
    chosen: str
    folds: Folds
    loss: str = "none"
    offered: tuple[Term, ...] = ()
    rigid_cross_validated: float | None = None
    reference: Chain | None = None

    @property
    def cross_validated(self) -> float:
        """Rms error of the chosen model on held-out rows [m], that of the last step used."""
        error = np.inf
        for rung in self.rungs:
            if rung.kept:
                error = rung.cross_validated
        return error

    def rigid_fit(self, measured: Sequence[PoseMeasurements], settings: Settings, bare: Chain | None) -> GeometricFit:
        """Return the best fit without any joint corrections (for a URDF).

        Corrections that the robot had before the fit are also left out.

        Args:
            measured: the fitted blocks.
            settings: settings of the fit.
            bare: the geometry the robot had before the fit that is valid without its corrections; None if it had none.
        """
        if bare is None:
            return self.rigid
        nominal = replace(self.nominal.cell, chain=bare, known=Deflection())
        placed = polish_frames(nominal, measured, settings)
        if self.chosen == "frames":
            return placed
        return fit(placed.cell, measured, layout(placed.cell).rigid_index, settings=settings)


def select_model(
    cell: Installation,
    measured: Sequence[PoseMeasurements],
    model: str = "auto",
    *,
    settings: Settings | None = None,
    fixed: np.ndarray | None = None,
    prior: np.ndarray | None = None,
    seed: int = 0,
    folds: Folds | None = None,
    progress: Progress | None = None,
    masses: np.ndarray | None = None,
    compliance: StatedCompliance | None = None,
) -> ModelSelection:
    """Return the model that the data support, or the model of a given name, fitted to all rows.

    Args:
        cell: nominal arm, with stations and tools placed (`calib.geometry.first_guess.install`).
        measured: blocks of measurements.
        model: ``auto`` selects the model; one of `MODELS` takes that step and all before it.
        settings: settings of every fit; None for the defaults. With loss ``auto``, rows beyond `MAX_RESIDUAL` robust
            sigmas of the rigid fit change the loss to ``cauchy``, for the fits and for the errors on held-out rows.
        fixed: indices of parameters that are not fitted; None for no such parameters.
        prior: standard deviations of the parameter vector about its nominal values, infinite for no prior; None for no
            prior at all.
        seed: seed of the regions of the joint space that are held out.
        folds: partition by which rows are held out; None for the most demanding one
            (`calib.geometry.model_choice.folds`).
        progress: called with (done, total, task): steps done, steps in all, name of the next step; None for no report.
        masses: (n, 10) standard parameters of the bodies, by which the blocks' torques were computed; None for those of
            the arm.
        compliance: compliance of joints that `cell` has as known; the full geometry is fitted with it as prior. None
            for no stated compliance.

    Raises:
        UsageError: the model does not exist.
    """
    one_of(model, ("auto", *MODELS), "model", UsageError)
    climber = _Climber(
        cell=cell,
        measured=measured,
        settings=settings or Settings(),
        fixed=NONE if fixed is None else fixed,
        prior=prior,
        transfer=folds or transfer_folds(measured, seed),
        progress=progress or _no_progress,
        seed=seed,
        masses=masses,
        compliance=compliance,
    )
    climber.rigid(model)
    if climber.settings.loss == "auto" and climber.best.outliers(MAX_RESIDUAL):
        climber = replace(climber, settings=replace(climber.settings, loss="cauchy"))
        climber.rigid(model)
    if model == "auto" or model in EFFECTS:
        climber.effects(model)
    return climber.result()


def _no_progress(done: int, total: int, task: str) -> None:
    """Do nothing; used where no progress report is requested."""


@dataclass
class _Climber:
    """State of a model selection: the best model so far, and the steps tried.

    Attributes:
        cell, measured, settings, fixed, prior, progress, seed, masses, compliance: arguments of `select_model`.
        transfer: the partition of the rows that was requested.
        folds: that partition, with those folds split that the other rows do not determine.
        nominal: the nominal arm with its placements fitted.
        best, chosen: the best model so far, and its name.
        stiff: the best model without effects.
        full: the fit of all rigid parameters, to which effects may be added; None where the user asked for a smaller
            model.
        error: rms error of the best rigid model on held-out rows [m].
        rungs, nominal_step: the steps tried, and the first of them.
        offered: terms of the chosen effects.
        ticks: number of calls of `progress` so far.
    """

    cell: Installation
    measured: Sequence[PoseMeasurements]
    settings: Settings
    fixed: np.ndarray
    prior: np.ndarray | None
    transfer: Folds
    progress: Progress
    seed: int
    masses: np.ndarray | None = None
    compliance: StatedCompliance | None = None

    def __post_init__(self) -> None:
        self.ticks = 0
        self.folds = self.transfer
        self._tick("frames")
        self.nominal = polish_frames(self.cell, self.measured, self.settings)
        self.best = self.stiff = self.nominal
        self.reference = self.nominal.cell.chain
        if self.masses is not None:
            self.reference = replace(self.reference, inertias=self.masses)
        self.full: GeometricFit | None = None
        self.chosen = "frames"
        self.offered: tuple[Term, ...] = ()
        self.rungs: list[ModelStep] = []
        measures_positions = all(isinstance(block, Positions) for block in self.measured)
        if self.folds.kind == "stations" and not self.folds.blind and measures_positions:
            self._divide_blind_folds()

    def _divide_blind_folds(self) -> None:
        """Split folds that the other rows do not determine: first by regions and, if this does not suffice, by
        single rows.
        """
        for scattered in (False, True):
            blind = blind_folds(self.nominal, self.measured, self.folds)
            if not blind.any():
                return
            self.folds = divide(self.folds, blind, self.measured, self.seed, scattered)

    def rigid(self, model: str) -> None:
        """Fit the rigid geometry, or only the placements or joint offsets where the user asks for these.

        Args:
            model: name of the requested model: ``frames`` (placements), ``offsets``, or any other for all rigid
                parameters.
        """
        rigid_model = model if model in RIGID_MODELS else "geometry"
        self.error = self._statistics(self.nominal, ()).error(NONE).rms
        self.nominal_step = ModelStep("frames", self.nominal.identified, 1e3 * self.error, rigid_model == "frames")
        self.rungs.append(self.nominal_step)
        self.best = self.stiff = self.nominal
        self.chosen = rigid_model
        self.full = None
        if rigid_model == "frames":
            return
        self._tick(rigid_model)
        table = layout(self.nominal.cell)
        candidates = table.rigid_index
        if rigid_model == "offsets":
            candidates = np.concatenate([self.nominal.cell.chain.driven, table.frame_index])
        candidates = np.setdiff1d(candidates, self.fixed)
        if self.compliance is not None and rigid_model == "geometry":
            self.best = self._with_compliance(self.compliance, candidates)
        else:
            self.best = fit(self.nominal.cell, self.measured, candidates, settings=self.settings, prior=self.prior)
        self.stiff = self.best
        self.error = self._statistics(self.best, ()).error(NONE).rms
        self.rungs.append(ModelStep(rigid_model, self.best.identified, 1e3 * self.error, True))
        if rigid_model == "geometry":
            self.full = self.best

    def _with_compliance(self, compliance: StatedCompliance, candidates: np.ndarray) -> GeometricFit:
        """Return the fit of the geometry and of a stated compliance, which has its sigma as prior.

        Args:
            compliance: the stated compliance.
            candidates: indices of the parameters of the geometry to fit.
        """
        rigid = self.nominal.cell
        prior = self.prior
        if prior is None:
            prior = np.full(len(layout(rigid).names), np.inf)
        cell = replace(rigid, deflection=compliance.deflection, known=Deflection())
        candidates = np.concatenate([candidates, layout(cell).index("deflection")])
        prior = np.concatenate([prior, compliance.sigma])
        return fit(cell, self.measured, candidates, settings=self.settings, prior=prior)

    def effects(self, model: str) -> None:
        """Add effects to the geometry one by one or, given the name of an effect, add this one and all before it.

        Effects that the selection added are removed again if the fit with them does not converge.

        Args:
            model: name of an effect, or ``auto`` to select the effects.
        """
        if self.full is None:
            return
        terms: list[Term] = []
        columns: dict[str, np.ndarray] = {}
        for name in EFFECTS:
            family = self._terms(name)
            columns[name] = np.arange(len(terms), len(terms) + len(family))
            terms += family
        self._tick("observation matrix")
        statistics = self._statistics(self.full, tuple(terms))
        rigid_rungs = tuple(self.rungs)
        if model == "auto":
            on_offer = {name: index for name, index in columns.items() if len(index)}
            effects = self._greedy(statistics, on_offer)
        else:
            names = list(EFFECTS)
            effects = names[: names.index(model) + 1]
        if not effects:
            return
        index = np.concatenate([columns[name] for name in effects])
        if model != "auto":
            self._tick(model)
            self.rungs.append(_rung(statistics, model, index, statistics.error(index).rms))
        self._tick("final fit")
        corrected = self._final(self.full, statistics, terms, index)
        status = corrected.solution.status
        if model == "auto" and not status.good and self.best.solution.status.good:
            note = f"did not converge ({status.name.lower()}): not used"
            declined = [replace(rung, kept=False, note=note) for rung in self.rungs[len(rigid_rungs) :]]
            self.rungs = [*rigid_rungs, *declined]
            return
        self.best = corrected
        self.chosen = " + ".join(["geometry", *effects])
        self.offered = tuple(terms[k] for k in index)
        last = max(k for k, rung in enumerate(self.rungs) if rung.kept)
        corrections = len(corrected.cell.deflection.terms)
        self.rungs[last] = replace(self.rungs[last], parameters=corrected.identified, corrections=corrections)

    def _greedy(self, statistics: FoldStatistics, columns: dict[str, np.ndarray]) -> list[str]:
        """Return the names of the effects that reduce the cross-validation error, best first (greedy selection).

        Compliance by torques is first where torques or loads are at hand: sag by fitted moments may explain one load as
        well, but it does not scale with the load.

        Args:
            statistics: statistics of every fold.
            columns: for each effect, the numbers of its terms among those of the statistics.
        """
        effects: list[str] = []
        index = NONE
        error = statistics.error(NONE)
        while len(effects) < len(columns):
            candidates = [name for name in columns if name not in effects]
            indices = {}
            errors = {}
            for name in candidates:
                self._tick(name)
                indices[name] = np.concatenate([index, columns[name]])
                errors[name] = statistics.error(indices[name])
            best = min(candidates, key=lambda name: errors[name].rms)
            if self._by_load and BY_LOAD in candidates and _pays(errors[BY_LOAD], error):
                best = BY_LOAD
            if not _pays(errors[best], error):
                for name in candidates:
                    note = _declined(errors[name], error)
                    self.rungs.append(_rung(statistics, name, indices[name], errors[name].rms, note))
                break
            self.rungs.append(_rung(statistics, best, indices[best], errors[best].rms))
            effects.append(best)
            index = indices[best]
            error = errors[best]
        return effects

    def _final(
        self, rigid: GeometricFit, statistics: FoldStatistics, terms: Sequence[Term], index: np.ndarray
    ) -> GeometricFit:
        """Return the fit of geometry and effects to all rows, with the most probable ridge of each term.

        Args:
            rigid: the fit of the geometry.
            statistics: statistics of every fold, from which the ridges follow.
            terms: all terms to which the statistics refer.
            index: numbers of the terms to fit; terms that the data switch off are omitted.
        """
        reference = self.reference
        ridges = statistics.ridges(index)
        alive = ridges > 0.0
        alive_terms = tuple(terms[k] for k in index[alive])
        cell = with_terms(rigid.cell, alive_terms, reference)
        geometry_prior = rigid.prior
        if geometry_prior is None:
            geometry_prior = np.full(len(rigid.free), np.inf)
        blocks = prepare(cell, self.measured)
        added = layout(cell).index("deflection")[len(rigid.cell.deflection.terms) :]
        free = np.concatenate([rigid.free, added])
        prior = np.concatenate([geometry_prior, ridges[alive]])
        start = with_terms(rigid.start, alive_terms, reference)
        nominal = replace(cell, chain=self.nominal.cell.chain, deflection=start.deflection)
        result = fit_with_prior(cell, blocks, free, prior, settings=self.settings, nominal=nominal)
        return replace(result, start=rigid.start, split=rigid.split, candidates=rigid.candidates)

    @property
    def _by_load(self) -> bool:
        """Whether torques or loads were measured or stated: what scales with them is then preferred, if it pays."""
        return any(block.measured_torque is not None or block.payload is not None for block in self.measured)

    def _terms(self, effect: str) -> list[Term]:
        """Return the terms of an effect; harmonics only up to the order that the number of poses can identify."""
        torques_known = all(block.torque is not None for block in self.measured)
        poses = sum(len(block) for block in self.measured)
        terms = EFFECTS[effect](self.reference, torques_known)
        max_order = poses // POSES_PER_ORDER
        terms = [term for term in terms if term.basis not in HARMONIC or term.order <= max_order]
        if self.compliance is None:
            return terms
        return [term for term in terms if term not in self.compliance.deflection.terms]

    def _statistics(self, fit: GeometricFit, terms: tuple[Term, ...]) -> FoldStatistics:
        return fold_statistics(fit, self.measured, terms, self.reference, self.folds)

    def _tick(self, task: str) -> None:
        self.progress(self.ticks, 2 * len(MODELS), task)
        self.ticks += 1

    def result(self) -> ModelSelection:
        """Return the result of the model selection."""
        loss = self.settings.loss
        if loss == "auto":
            loss = "none"
        rigid_error = self.error
        if self.nominal.cell.known.terms:
            # the error is of an arm with the corrections that it came with
            rigid_error = None
        return ModelSelection(
            fit=self.best,
            nominal=self.nominal,
            nominal_step=self.nominal_step,
            rigid=self.stiff,
            rungs=tuple(self.rungs),
            chosen=self.chosen,
            folds=self.folds,
            loss=loss,
            offered=self.offered,
            reference=self.reference,
            rigid_cross_validated=rigid_error,
        )


def _pays(effect: UnseenErrors, error: UnseenErrors) -> bool:
    """Return whether an effect reduces the errors on held-out rows enough to be added.

    Args:
        effect: errors with the effect.
        error: errors without it.
    """
    return effect.rms < error.rms * (1.0 - MIN_GAIN) and effect.wins(error)


def _declined(effect: UnseenErrors, error: UnseenErrors) -> str:
    """Return why an effect is not used: the change of the error on held-out rows, and the number of better folds.

    Args:
        effect: errors with the effect.
        error: errors without it.
    """
    gain = 1.0 - effect.rms / error.rms
    if gain <= 0.0:
        return "no better on held-out rows: not used"
    folds = len(error.squares)
    better = int(np.sum(effect.squares < error.squares))
    return f"{100.0 * gain:.0f} % better on held-out rows, in {better} of {folds} folds: not used"


def _rung(statistics: FoldStatistics, effect: str, index: np.ndarray, rms: float, note: str = "") -> ModelStep:
    """Return the step of an effect, from its cross-validation error `rms` [m].

    The effect is used in the next models if `note` is empty.

    Args:
        statistics: statistics of every fold.
        effect: name of the effect.
        index: numbers of the terms of the model.
        rms: cross-validation error [m].
        note: reason for not using the effect.
    """
    # terms that the data do not switch off
    corrections = int(np.sum(statistics.ridges(index) > 0.0))
    return ModelStep(
        model=f"+ {effect}",
        parameters=statistics.identified + corrections,
        cross_validated_mm=1e3 * rms,
        kept=not note,
        note=note,
        corrections=corrections,
    )
