"""Model selection: which joint corrections are added to the geometry, judged on rows that were not fitted.

    geometry → + stiffness → + bending → + coupling → + harmonics → + wobble

The rigid geometry is not selected: it is the most probable one under priors of making (`calib.geometry.fit`), or the
frames or joint offsets alone where the user asks for these. Of the effects on top of it, the one that lowers the error
on held-out rows (`calib.geometry.model_choice.folds`) most is taken up, then the one that pays most beside it, until
none pays: sag may show only once gear errors are gone.

The effects a ladder of models may add to the geometry, each a family of deflection terms.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.data.poses import MODELS as CHOICES
from calib.data.poses.measurements import PoseMeasurements, Positions
from calib.errors import UsageError, one_of
from calib.geometry.fit import fit, fit_with_prior, polish_frames
from calib.geometry.installation import Installation
from calib.geometry.model_choice.cross_validation import FoldStatistics, UnseenErrors, blind_folds, fold_statistics
from calib.geometry.model_choice.folds import Folds, divide, transfer_folds
from calib.geometry.observation import layout, prepare
from calib.geometry.weighing import GeometricFit, Settings
from calib.robot.calibrated import Deflection, Term
from calib.robot.chain import Chain


def _stiffness(chain: Chain, known: bool) -> list[Term]:
    """Return the terms of joint deflection about the axis under gravity: by known torques, else fitted moments."""
    names = chain.names
    if known:
        return [Term(names[k], "torque", j) for j, k in enumerate(chain.moving) if chain.joints[j].kind == "revolute"]
    return [term for k in chain.moving if chain.elements[k].axis[0] == "r" for term in _sag(chain, int(k))]


def _bending(chain: Chain, known: bool) -> list[Term]:
    """Return the terms for tilt of each joint's axis under gravity, due to compliant bearings and links."""
    moving = set(chain.moving.tolist())
    places = [k for k, e in enumerate(chain.elements) if e.axis[0] == "r" and k not in moving and e.owner < chain.n]
    return [term for k in places for term in _sag(chain, k)]


def _sag(chain: Chain, place: int) -> list[Term]:
    element = chain.elements[place]
    return [Term(element.name, "lever", i, a) for i in range(element.owner, chain.n) for a in range(3)]


def _coupling(chain: Chain, known: bool) -> list[Term]:
    """Return the terms that correct a joint by its reading and its neighbours': gear ratio, coupled gears."""
    names = chain.names
    near = [(j, i) for j in range(chain.n) for i in (j - 1, j, j + 1) if 0 <= i < chain.n]
    return [Term(names[chain.moving[j]], "joint", i) for j, i in near]


def _harmonics(chain: Chain, known: bool, max_order: int = 60) -> list[Term]:
    """Return the terms sin k q_j, cos k q_j of each revolute joint, k = 1 … `max_order`: encoder and gear errors."""
    return _turning(chain, [(chain.names[k], j) for j, k in enumerate(chain.moving)], max_order)


def _wobble(chain: Chain, known: bool, max_order: int = 2) -> list[Term]:
    """Return low harmonics of q_j on every other element of joint j: wobble of its axis."""
    moving = set(chain.moving.tolist())
    places = [(e.name, e.owner) for k, e in enumerate(chain.elements) if k not in moving and e.owner < chain.n]
    return _turning(chain, places, max_order)


def _turning(chain: Chain, places: list[tuple[str, int]], max_order: int) -> list[Term]:
    """Return the harmonic terms of given elements, in the angle of their revolute joint; none for prismatic joints."""
    revolute = [(name, j) for name, j in places if chain.joints[j].kind == "revolute"]
    orders = range(1, max_order + 1)
    return [Term(name, basis, j, order) for name, j in revolute for order in orders for basis in ("cos", "sin")]


MODELS = CHOICES[1:]
RIGID_MODELS = ("frames", "offsets", "geometry")
NONE = np.array([], dtype=int)
FAMILIES = (_stiffness, _bending, _coupling, _harmonics, _wobble)
# by name: from a chain, and whether gravity torques are known, to terms
EFFECTS: dict[str, Callable[[Chain, bool], list[Term]]] = dict(zip(MODELS[3:], FAMILIES, strict=True))


MIN_GAIN = 0.03  # an effect has to lower the error on unseen rows by this share (our choice)

MAX_RESIDUAL = 8.0  # robust sigmas beyond which a row is not of this robot (our choice)

Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class ModelStep:
    """One step of the ladder: a model that was tried.

    Attributes:
        model: its name, e.g. ``geometry`` or ``+ harmonics``.
        parameters: how many it fits.
        cross_validated_mm: rms error on unseen rows; None in files of earlier versions.
        kept: whether the next steps include it.
        note: why, in words.
        corrections: how many of the parameters are small joint corrections, shrunk by a ridge.
    """

    model: str
    parameters: int
    cross_validated_mm: float | None
    kept: bool
    note: str = ""
    corrections: int = 0

    @property
    def cross_validated(self) -> float:
        """Cross-validation error: rms on held-out rows [m]."""
        return np.nan if self.cross_validated_mm is None else 1e-3 * self.cross_validated_mm


@dataclass(frozen=True, eq=False)
class ModelSelection:
    """Result of the model selection.

    Attributes:
        fit: the chosen model, fitted to all rows.
        nominal: the nominal arm with its frames fitted to all rows.
        rigid: the best fit without effects, to all rows. The geometry in ``fit`` is valid only together with its
            effects, with which it is correlated; use this one without effects (for a URDF).
        rungs: all models tried, in order.
        chosen: name of the chosen model, e.g. ``geometry + harmonics``.
        folds: how the unseen rows were set aside.
        loss: the loss that was used.
        offered: all terms of the effects that were taken up; those in ``fit`` are the ones the data kept.
        rigid_cross_validated: rms error of the best model without effects on held-out rows [m].
    """

    fit: GeometricFit
    nominal: GeometricFit
    rigid: GeometricFit
    rungs: tuple[ModelStep, ...]
    chosen: str
    folds: Folds
    loss: str = "none"
    offered: tuple[Term, ...] = ()
    rigid_cross_validated: float | None = None

    @property
    def cross_validated(self) -> float:
        """The error of the chosen model on held-out rows [m]: that of the last step kept."""
        return ([rung.cross_validated for rung in self.rungs if rung.kept] or [np.inf])[-1]

    def rigid_fit(self, measured: Sequence[PoseMeasurements], settings: Settings, bare: Chain | None) -> GeometricFit:
        """Return the best fit without any joint corrections (for a URDF), not even those of the robot as it came.

        Args:
            measured: the blocks that were fitted.
            settings: of the fit.
            bare: the geometry of the robot as it came that is valid without its corrections; None if it has none.
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
) -> ModelSelection:
    """Return the model that the data support, or the one chosen by name, fitted to all rows.

    Args:
        cell: nominal arm, frames placed (`calib.geometry.first_guess.install`).
        measured: blocks of measurements.
        model: ``auto``, or one of `MODELS`: that step and all before it.
        settings: of every fit. With loss ``auto``, rows beyond `MAX_RESIDUAL` robust sigmas of the rigid fit change it
            to ``cauchy``, for fits and errors on unseen rows.
        fixed: positions in the parameter vector that stay at their nominal.
        prior: standard deviations of the parameter vector about its nominal; infinite without a prior.
        seed: of the regions.
        folds: how unseen rows are set aside; None for the most demanding way (`calib.geometry.model_choice.folds`).
        progress: called with (done, total, what).

    Raises:
        UsageError: for a model that does not exist.
    """
    one_of(model, ("auto", *MODELS), "model", UsageError)
    climber = _Climber(
        cell,
        measured,
        settings or Settings(),
        NONE if fixed is None else fixed,
        prior,
        folds or transfer_folds(measured, seed),
        progress or (lambda done, total, what: None),
        seed,
    )
    climber.rigid(model)
    if climber.settings.loss == "auto" and climber.best.outliers(MAX_RESIDUAL):
        climber = replace(climber, settings=replace(climber.settings, loss="cauchy"))
        climber.rigid(model)
    if model == "auto" or model in EFFECTS:
        climber.effects(model)
    return climber.result()


@dataclass
class _Climber:
    """State of one model selection: the best model so far and the steps tried; see `select_model` for its fields."""

    cell: Installation
    measured: Sequence[PoseMeasurements]
    settings: Settings
    fixed: np.ndarray
    prior: np.ndarray | None
    asked: Folds
    progress: Progress
    seed: int

    def __post_init__(self) -> None:
        self.steps, self.folds = -1, self.asked
        self._tick("frames")
        self.nominal = self.best = self.stiff = polish_frames(self.cell, self.measured, self.settings)
        self.rungs: list[ModelStep] = []
        self.chosen, self.offered = "frames", tuple[Term, ...]()
        positions = all(isinstance(block, Positions) for block in self.measured)
        if self.folds.kind == "stations" and not self.folds.blind and positions:
            for scattered in (False, True):
                blind = blind_folds(self.nominal, self.measured, self.folds)
                if not blind.any():
                    break
                self.folds = divide(self.folds, blind, self.measured, self.seed, scattered)

    def rigid(self, model: str) -> None:
        """Fit the rigid geometry, or the frames or joint offsets alone where the user asks for these."""
        table = layout(self.nominal.cell)
        chosen = model if model in RIGID_MODELS else "geometry"
        nominal_error = self._statistics(self.nominal, ()).error(NONE).rms
        self.rungs.append(ModelStep("frames", self.nominal.identified, 1e3 * nominal_error, chosen == "frames"))
        self.best, self.chosen, self.error = self.nominal, "frames", nominal_error
        self.full = None
        if chosen != "frames":
            self._tick(chosen)
            candidates = table.rigid_index
            if chosen == "offsets":
                candidates = np.concatenate([self.nominal.cell.chain.driven, table.frame_index])
            result = fit(
                self.nominal.cell,
                self.measured,
                np.setdiff1d(candidates, self.fixed),
                settings=self.settings,
                prior=self.prior,
            )
            self.best, self.chosen = result, chosen
            self.error = self._statistics(result, ()).error(NONE).rms
            self.rungs.append(ModelStep(chosen, result.identified, 1e3 * self.error, True))
        if chosen == "geometry":
            self.full = self.best
        self.stiff = self.best

    def effects(self, model: str) -> None:
        """Add effects to the geometry one by one; for an effect's name, use it and all before it.

        Effects whose fit does not come to an end, though the user did not ask for them, are left out again.
        """
        if self.full is None:
            return
        terms_of = {name: self._terms(name) for name in EFFECTS}
        terms = tuple(term for family in terms_of.values() for term in family)
        self._tick("observation matrix")
        statistics = self._statistics(self.full, terms)
        edges = np.cumsum([0, *map(len, terms_of.values())])
        columns = {name: np.arange(*edges[k : k + 2]) for k, name in enumerate(terms_of)}
        rigid_rungs, names = tuple(self.rungs), list(EFFECTS)
        if model == "auto":
            effects = self._greedy(statistics, {name: columns[name] for name in names if terms_of[name]})
        else:
            effects = names[: names.index(model) + 1]
            selected = np.concatenate([columns[name] for name in effects])
            self._tick(model)
            self.rungs.append(_rung(statistics, model, selected, statistics.error(selected).rms))
        if not effects:
            return
        self._tick("final fit")
        selected = np.concatenate([columns[name] for name in effects])
        corrected = self._final(self.full, statistics, terms, selected)
        status = corrected.solution.status
        if model == "auto" and not status.good and self.best.solution.status.good:
            note = f"did not converge ({status.name.lower()}): not used"
            tried = self.rungs[len(rigid_rungs) :]
            self.rungs = [*rigid_rungs, *(replace(rung, kept=False, note=note) for rung in tried)]
            return
        self.best, self.chosen = corrected, " + ".join(["geometry", *effects])
        self.offered = tuple(terms[k] for k in selected)
        last = max(k for k, rung in enumerate(self.rungs) if rung.kept)
        corrections = len(corrected.cell.deflection.terms)
        self.rungs[last] = replace(self.rungs[last], parameters=corrected.identified, corrections=corrections)

    def _greedy(self, statistics: FoldStatistics, place: dict[str, np.ndarray]) -> list[str]:
        """Return the effects that reduce the cross-validation error, best first (greedy selection).

        Args:
            place: indices of each effect's terms among those of the statistics.
        """
        kept: list[str] = []
        error = statistics.error(NONE)
        while waiting := [name for name in place if name not in kept]:
            tried = {}
            where = {name: np.concatenate([place[other] for other in [*kept, name]]) for name in waiting}
            for name in waiting:
                self._tick(name)
                tried[name] = statistics.error(where[name])
            best = min(waiting, key=lambda name: tried[name].rms)
            pays = tried[best].rms < error.rms * (1.0 - MIN_GAIN) and tried[best].wins(error)
            for name in [best] if pays else waiting:
                note = "" if pays else _declined(tried[name], error)
                self.rungs.append(_rung(statistics, name, where[name], tried[name].rms, note))
            if not pays:
                break
            kept.append(best)
            error = tried[best]
        return kept

    def _final(
        self, rigid: GeometricFit, statistics: FoldStatistics, terms: tuple[Term, ...], where: np.ndarray
    ) -> GeometricFit:
        """Return the fit of geometry and effects to all rows, each term with its most probable ridge."""
        ridge, reference = statistics.ridges(where), self.nominal.cell.chain
        picked = tuple(terms[k] for k in where[ridge > 0.0])
        cell = replace(rigid.cell, deflection=Deflection(picked, np.zeros(len(picked)), reference))
        free = np.concatenate([rigid.free, layout(cell).index("deflection")])
        own = np.full(len(rigid.free), np.inf) if rigid.prior is None else rigid.prior
        found = fit_with_prior(
            cell,
            prepare(cell, self.measured),
            free,
            np.concatenate([own, ridge[ridge > 0.0]]),
            settings=self.settings,
            nominal=replace(cell, chain=reference),
        )
        return replace(found, start=rigid.start, split=rigid.split, candidates=rigid.candidates)

    def _terms(self, effect: str, poses_per_order: int = 8) -> list[Term]:
        """Return the terms of an effect; harmonics only up to the order that the number of poses can identify.

        `poses_per_order`: harmonics of order k are offered to sets of at least 8 k poses (our choice).
        """
        known = all(block.torque is not None for block in self.measured)
        highest = sum(len(block) for block in self.measured) // poses_per_order
        terms = EFFECTS[effect](self.nominal.cell.chain, known)
        return [term for term in terms if term.basis not in ("cos", "sin") or term.order <= highest]

    def _statistics(self, found: GeometricFit, terms: tuple[Term, ...]) -> FoldStatistics:
        return fold_statistics(found, self.measured, terms, self.nominal.cell.chain, self.folds)

    def _tick(self, what: str) -> None:
        self.steps += 1
        self.progress(self.steps, 2 * len(MODELS), what)

    def result(self) -> ModelSelection:
        loss = "none" if self.settings.loss == "auto" else self.settings.loss
        known = self.nominal.cell.known.terms
        return ModelSelection(
            self.best,
            self.nominal,
            self.stiff,
            tuple(self.rungs),
            self.chosen,
            self.folds,
            loss,
            self.offered,
            None if known else self.error,
        )


def _declined(tried: UnseenErrors, error: UnseenErrors) -> str:
    """Return why an effect is not used: by how much it changes the error on held-out rows, and in how many folds."""
    gain = 1.0 - tried.rms / error.rms
    if gain <= 0.0:
        return "no better on held-out rows: not used"
    folds, better = len(error.squares), int(np.sum(tried.squares < error.squares))
    return f"{100.0 * gain:.0f} % better on held-out rows, in {better} of {folds} folds: not used"


def _rung(statistics: FoldStatistics, effect: str, where: np.ndarray, rms: float, note: str = "") -> ModelStep:
    """Return the ladder step of an effect from its cross-validation error `rms` [m]; kept if `note` is empty."""
    shrunk = int(np.sum(statistics.ridges(where) > 0.0))  # terms that the data do not switch off
    return ModelStep(f"+ {effect}", statistics.identified + shrunk, 1e3 * rms, not note, note, shrunk)
