"""Selection of poses by any of the search methods, and the selection's result."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from .by_index import exchanged_by_index, kicked_by_index, merits
from .candidates import draw_candidates
from .continuous.global_local import mlsl_search
from .continuous.local import Improved, improved
from .continuous.multistart import multistart_search, random_starts
from .continuous.tabu import DEFAULT_RULE, TabuRule, tabu_search
from .convex import Bound, relaxed
from .design import Design, Pool, design_of
from .errors import BadInput, NotIdentifiable
from .exchange import detmax, exchanged, greedy, kicked
from .indices import Index, merit, observability
from .scaled_jacobians import Candidates, checked, log_det, prepared
from .space import SearchSpace, is_feasible
from .whole_space import Ceiling, bound_over_space

Method = Literal["detmax", "polish", "local", "multistart", "mlsl", "tabu"]
Progress = Callable[[int, int, str], None]

# trial sets of the restarts for other indices than O1, for each kick asked for (our choice): with ten kicks some 60
# restarts of 7 poses among 18, 10 of 30 among 2000
TRIALS_PER_KICK = 2000


@dataclass(frozen=True)
class SearchSettings:
    """Settings of the search for poses.

    Attributes:
        index: "O1" ... "O5", "cond". O1 is the default because its ranking of sets does not depend on the units of the
            parameters.
        method: see `select_poses`.
        count: candidates to generate if none are given.
        seed: of every random draw; the same seed gives the same selection.
        kicks: random restarts of detmax around its best set; skipped if at most 0.5 % can be gained. For other indices
            than O1 as many restarts as 2000 trial sets for each kick last.
        starts: start sets of multistart.
        evaluations: largest number of evaluations of one local search.
        rule: settings of the tabu search.
        seconds: processor time after which the search stops; bounds and baseline not counted.
        climbs: local searches for poses that exceed the bound, see `calib.poses.whole_space`; 0: the bound covers the
            candidates and the chosen poses only.
    """

    index: Index = "O1"
    method: Method = "detmax"
    count: int = 2000
    seed: int = 0
    kicks: int = 10
    starts: int = 8
    evaluations: int = 5000
    rule: TabuRule = DEFAULT_RULE
    seconds: float = np.inf
    climbs: int = 0


DEFAULT_SEARCH = SearchSettings()


@dataclass(frozen=True)
class Selection:
    """Chosen poses with their index, efficiency and bounds.

    Attributes:
        q: (m, n) joint values [rad or m]; None where the candidates were given without joint values.
        indices: (m,) indices of the chosen candidates, rising; None for methods whose poses are not candidates.
        index: name of the index the search improved.
        value: value of that index for the chosen poses together with the poses measured before (m counts both).
        history: values of the index as the search improved it; the last is `value`.
        efficiency: det(WᵀW)^(1/p) divided by `ceiling.upper`, at most 1.
        bound: upper bound by convex relaxation over the candidates; poses that are not candidates may exceed it.
        ceiling: the upper bound used for the efficiency: over all feasible poses where the settings' `climbs` is above
            0, else over the candidates and the chosen poses.
        random_baseline: best value of the index among 1000 random sets of the candidates.
        seconds: wall-clock time [s], bound and baseline included.
        evaluations: designs accepted (detmax) or evaluations of the index (the others).
        seed, method: seed and method of the search, which reproduce the selection.
        interrupted: True where Ctrl-C ended the search; the selection is then the best set reached.
    """

    q: np.ndarray | None
    indices: np.ndarray | None
    index: Index
    value: float
    history: np.ndarray
    efficiency: float
    bound: Bound
    ceiling: Ceiling
    random_baseline: float
    seconds: float
    evaluations: int
    seed: int
    method: Method
    interrupted: bool = False

    @property
    def joints(self) -> np.ndarray:
        """Return the joint values (m, n) [rad or m] of the chosen poses.

        Raises:
            BadInput: the candidates were given without joint values.
        """
        if self.q is None:
            raise BadInput("the candidates have no joint values: use `indices` of the chosen ones")
        return self.q


@dataclass(frozen=True)
class _Chosen:
    """Poses chosen by one search method.

    Attributes:
        members: indices into the candidates; None for methods whose poses are not candidates.
        q: (m, n) joint values [rad or m]; None where `members` is given.
        merits: history of the merit log O, rising.
        evaluations: designs accepted, or evaluations of the index.
        interrupted: True where Ctrl-C ended the search.
    """

    members: tuple[int, ...] | None
    q: np.ndarray | None
    merits: tuple[float, ...]
    evaluations: int
    interrupted: bool


@dataclass(frozen=True)
class _Request:
    """Input of every search method: the candidates, their upper bound, and the arguments of `select_poses`."""

    jacobians: np.ndarray
    q: np.ndarray | None
    candidates: Candidates
    bound: Bound
    m: int
    index: Index
    seed: int
    before: np.ndarray | None
    space: SearchSpace | None
    progress: Progress
    settings: SearchSettings
    map: Callable


def select_poses(
    jacobians: ArrayLike | None,
    m: int,
    settings: SearchSettings = DEFAULT_SEARCH,
    *,
    q: ArrayLike | None = None,
    space: SearchSpace | None = None,
    existing: ArrayLike | None = None,
    map: Callable = map,
    progress: Progress | None = None,
) -> Selection:
    """Return m poses that make the parameters as observable as possible.

    * ``detmax`` chooses among the candidates: start from the rounded relaxation and from a greedy set, pair exchange,
      DETMAX excursions, random restarts (`calib.poses.exchange`). For indices other than O1 the resulting set is then
      improved by `calib.poses.by_index`.
    * ``polish`` starts from the set of ``detmax`` and improves all joint values at once
      (`calib.poses.continuous.local`).
    * ``local`` runs the same local search from one random set of candidates, as Kolyubin, Shiriaev & Jubien (2019) did
      for the KUKA LWR4+. ``multistart`` runs it from `starts` random sets (`calib.poses.continuous.multistart`), to
      avoid poor local optima.
    * ``mlsl`` searches all joint values globally by NLopt's MLSL, then runs the local search
      (`calib.poses.continuous.global_local`).
    * ``tabu`` is IMHATR, the two-stage meta-heuristic (`calib.poses.continuous.tabu`).

    Args:
        jacobians: (N, rows, p) observation Jacobians of the candidates by the p base parameters, whitened: each row
            divided by its standard deviation. None computes them by `space` at q, or at feasible Sobol poses where q is
            None too.
        m: number of poses to choose; detmax takes no candidate twice.
        settings: index, method and effort.
        q: (N, n) joint values of the candidates [rad or m]; None if unknown, or to draw them.
        space: limits, constraints and Jacobian; needed by all methods but detmax. None without it.
        existing: (k, rows, p) whitened Jacobians of poses already measured, whose information is added; None for no
            such poses.
        map: the builtin, or a parallel map on which multistart runs its starts.
        progress: called with (done, total, message); None for no report.

    Raises:
        BadInput: an unknown method or index, invalid arrays, or no `space` where the method needs one.
        TooFewCandidates: fewer candidates than m.
        NothingFeasible: too few feasible poses can be drawn.
        NotIdentifiable: m poses, or all candidates together, cannot determine all parameters.
    """
    began = time.perf_counter()
    method, index, seed = settings.method, settings.index, settings.seed
    if method not in get_args(Method):
        names = ", ".join(get_args(Method))
        raise BadInput(f"method '{method}' is not known; take one of {names}")
    if method != "detmax" and space is None:
        raise BadInput(f"method '{method}' moves joint values continuously: give space, with limits and a Jacobian")
    array, joints = _candidates(jacobians, q, space, settings.count, seed)
    before = None
    if existing is not None:
        before = checked(existing, "existing")
    report = progress or (lambda done, total, message: None)
    report(0, 1, "convex bound")
    candidates = prepared(array, m, before)
    bound = relaxed(candidates, m)
    task = _Request(array, joints, candidates, bound, m, index, seed, before, space, report, settings, map)
    baseline = random_baseline(array, m, index, before, seed=seed)
    match method:
        case "detmax":
            chosen = _exchange(task)
        case "polish":
            chosen = _polished(task)
        case "local" | "multistart":
            chosen = _multistart(task, settings.starts if method == "multistart" else 1)
        case "mlsl":
            chosen = _mlsl(task)
        case "tabu":
            chosen = _tabu(task)
    return _selection(task, chosen, baseline, began)


def random_baseline(
    jacobians: np.ndarray, m: int, index: Index = "O1", existing: np.ndarray | None = None, *, seed: int = 0, sets=1000
) -> float:
    """Return the best index among random sets of m candidates, as a baseline without optimisation.

    Args:
        jacobians: (N, rows, p) whitened Jacobians of the candidates.
        m: poses per set.
        index: "O1" ... "O5", "cond".
        existing: (k, rows, p) Jacobians of poses already measured, added to every set; None for no such poses.
        seed: seed of the draw.
        sets: number of sets drawn.
    """
    generator = np.random.default_rng(seed)
    count, _, p = jacobians.shape
    known_information = np.zeros((p, p))
    if existing is not None:
        measured_rows = existing.reshape(-1, p)
        known_information = measured_rows.T @ measured_rows
    best = -np.inf
    best_set = np.arange(m)
    chunk = max(1, 2_000_000 // (m * jacobians.shape[1] * p))
    for first in range(0, sets, chunk):
        sets_of_chunk = min(chunk, sets - first)
        subsets = [generator.choice(count, m, replace=False) for _ in range(sets_of_chunk)]
        drawn = np.array(subsets)
        rows = jacobians[drawn].reshape(len(drawn), -1, p)
        information = rows.transpose(0, 2, 1) @ rows
        matrices = known_information + information
        if index == "O1":
            values = log_det(matrices)
        else:
            values = merits(matrices, index)
        if values.max() > best:
            best = float(values.max())
            best_set = drawn[values.argmax()]
    return _value(jacobians[best_set], existing, index)


def _candidates(
    jacobians: ArrayLike | None, q: ArrayLike | None, space: SearchSpace | None, count: int, seed: int
) -> tuple[np.ndarray, np.ndarray | None]:
    joints = None if q is None else np.asarray(q, dtype=float)
    if jacobians is None:
        if space is None:
            raise BadInput("no candidates: give jacobians, or a space")
        if joints is None:
            joints = draw_candidates(space.lower, space.upper, count, lambda x: is_feasible(space, x), seed=seed)
        jacobians = space.jacobian(joints)
    array = checked(jacobians)
    if joints is not None and (joints.ndim != 2 or len(joints) != len(array)):
        raise BadInput(f"q: expected ({len(array)}, n) joint values for {len(array)} candidates, found {joints.shape}")
    return array, joints


def _exchange(task: _Request) -> _Chosen:
    """Return the poses of `task` chosen by exchange of candidates (detmax); after Ctrl-C the best set reached."""
    candidates = task.candidates
    m = task.m
    p = task.jacobians.shape[2]
    all_candidates = Pool(candidates.z, candidates.known)
    # Candidates of small score at the relaxed optimum are hardly ever chosen: search the promising ones (1000 at least,
    # our choice), and polish among all at the end.
    short_count = max(1000, 15 * m)
    order = np.argsort(-task.bound.scores, kind="stable")
    short = np.sort(order[:short_count])
    pool = Pool(candidates.z[short], candidates.known)
    weights = task.bound.weights[short]
    best: list[tuple[tuple[int, ...], float]] = []

    def keep(design: Design, where: np.ndarray = short) -> None:
        if not best or design.logdet > best[-1][1]:
            members = tuple(int(where[i]) for i in design.members)
            best.append((members, design.logdet))

    def stage(number: int, message: str) -> None:
        task.progress(number, 5, message)

    interrupted = False
    began = time.process_time()
    try:
        stage(1, "exchange from the rounded relaxation")
        order = np.argsort(-weights, kind="stable")[:m]
        members = tuple(int(i) for i in order)
        rounded = design_of(pool, members)
        keep(rounded)
        designs = [exchanged(pool, rounded, keep)]
        stage(2, "greedy start and exchange")
        designs.append(exchanged(pool, greedy(pool, m), keep))
        stage(3, "DETMAX excursions and kicks")
        design = detmax(pool, max(designs, key=lambda d: d.logdet), keep)
        # Kicks are skipped where the certificate leaves less than half a percent to win.
        log_ratio = task.bound.log_upper - candidates.shift - design.logdet
        remaining = log_ratio / p
        kicks = 0
        if remaining > 0.005:
            kicks = task.settings.kicks
        elapsed = time.process_time() - began
        seconds = task.settings.seconds - elapsed
        design = kicked(pool, design, kicks, task.seed, keep, weights=weights, seconds=seconds)
        keep(design)
        stage(4, "exchange among all candidates")
        all_indices = np.arange(len(candidates.z))
        members, _ = best[-1]
        start = design_of(all_candidates, members)
        polished = exchanged(all_candidates, start, lambda design: keep(design, all_indices))
        keep(polished, all_indices)
    except KeyboardInterrupt:
        if not best:
            raise
        interrupted = True
    rising = tuple((logdet + candidates.shift) / (2 * p) for _, logdet in best)
    chosen = _Chosen(best[-1][0], None, rising, len(best), interrupted)
    if task.index != "O1" and not interrupted:
        elapsed = time.process_time() - began
        chosen = _by_index(task, chosen.members or (), task.settings.seconds - elapsed)
    stage(5, "done")
    return chosen


def _by_index(task: _Request, members: tuple[int, ...], seconds: float) -> _Chosen:
    """Return the D-optimal set `members` improved by exchanges for the requested index, where the index is not O1.

    Args:
        task: candidates and arguments of `select_poses`.
        members: indices of the set's candidates.
        seconds: processor time [s] after which the exchange is not restarted any more.
    """
    p = task.jacobians.shape[2]
    past = np.zeros((0, p))
    if task.before is not None:
        past = task.before.reshape(-1, p)
    known_information = past.T @ past
    chosen_rows = task.jacobians[list(members)].reshape(-1, p)
    rows = np.concatenate([past, chosen_rows])
    value, _ = merit(rows, task.index)
    best = [(members, value)]

    def keep(improved_members: tuple[int, ...], improved_value: float) -> None:
        best.append((improved_members, improved_value))

    interrupted = False
    try:
        information = task.jacobians, known_information
        optimum = exchanged_by_index(*information, members, task.index, keep)
        trials = TRIALS_PER_KICK * task.settings.kicks
        optimum = kicked_by_index(*information, optimum, task.index, trials, task.seed, keep, seconds=seconds)
        # the kicks tried fewer candidates
        exchanged_by_index(*information, optimum.members, task.index, keep)
    except KeyboardInterrupt:
        interrupted = True
    rising = tuple(value for _, value in best)
    return _Chosen(best[-1][0], None, rising, len(best), interrupted)


def _polished(task: _Request) -> _Chosen:
    """Return poses chosen among the candidates, then improved in all joint values continuously.

    Args:
        task: candidates, search space and arguments of `select_poses`.
    """
    began = time.process_time()
    chosen = _exchange(task)
    if chosen.interrupted:
        return chosen
    space, joints = _movable(task)
    start = joints[sorted(chosen.members or ())]
    elapsed = time.process_time() - began
    remaining = task.settings.seconds - elapsed
    task.progress(0, 1, "local search")
    effort = task.settings
    run = improved(space, start, task.index, task.before, evaluations=effort.evaluations, seconds=remaining)
    return _of(run)


def _multistart(task: _Request, starts: int) -> _Chosen:
    """Return the best result of the local search from `starts` random sets of candidates.

    Args:
        task: candidates, search space and arguments of `select_poses`.
        starts: number of random sets.
    """
    space, joints = _movable(task)

    def report(number: int, _: Improved) -> None:
        task.progress(number + 1, starts, "local searches")

    run = multistart_search(
        space,
        random_starts(joints, task.m, starts, task.seed),
        task.index,
        task.before,
        evaluations=task.settings.evaluations,
        seconds=task.settings.seconds,
        map=task.map,
        report=report,
    )
    return _of(run)


def _mlsl(task: _Request) -> _Chosen:
    """Return a set of poses searched by MLSL within the joint limits, beginning at a random set of candidates.

    Args:
        task: candidates, search space and arguments of `select_poses`.
    """
    space, joints = _movable(task)
    task.progress(0, 1, "global search")
    [start] = random_starts(joints, task.m, 1, task.seed)
    effort = task.settings
    run = mlsl_search(space, start, task.index, task.before, evaluations=effort.evaluations, seconds=effort.seconds)
    return _of(run)


def _movable(task: _Request) -> tuple[SearchSpace, np.ndarray]:
    if task.space is None or task.q is None:
        raise BadInput(f"{task.settings.method} changes joint values: give space, and q with jacobians")
    return task.space, task.q


def _tabu(task: _Request) -> _Chosen:
    if task.space is None:
        raise BadInput("tabu generates poses itself: the argument space is needed")

    def report(chosen: int, _: float) -> None:
        task.progress(chosen, task.m, "poses constructed")

    effort = task.settings
    run = tabu_search(
        task.space,
        task.m,
        task.index,
        task.before,
        seed=task.seed,
        rule=effort.rule,
        seconds=effort.seconds,
        report=report,
    )
    return _of(run)


def _of(run: Improved) -> _Chosen:
    return _Chosen(None, run.q, run.history, run.evaluations, run.interrupted)


def _selection(task: _Request, chosen: _Chosen, baseline: float, began: float) -> Selection:
    indices = None
    q = chosen.q
    if q is None:
        indices = np.array(sorted(chosen.members or ()))
        jacobians = task.jacobians[indices]
        if task.q is not None:
            q = task.q[indices]
    else:
        jacobians = task.jacobians[:0]
        if task.space:
            jacobians = np.asarray(task.space.jacobian(q), dtype=float)
    value = _value(jacobians, task.before, task.index)
    if not value > 0 or not np.isfinite(value):
        raise NotIdentifiable(
            f"no set of {task.m} poses of full rank was found, although the candidates together have it: ask for more "
            "poses"
        )
    poses = task.m
    if task.before is not None:
        poses += len(task.before)
    climbs = task.settings.climbs
    if chosen.interrupted:
        climbs = 0
    ceiling = _ceiling(task, q, climbs)
    d_index = _value(jacobians, task.before, "O1")
    efficiency = d_index**2 * poses / ceiling.upper
    sign = 1.0
    if task.index == "cond":
        sign = -1.0
    history = np.exp(np.array(chosen.merits) * sign)
    if task.index == "O1":
        history = history / np.sqrt(poses)
    history = np.append(history[:-1], value)
    out = Selection(
        q,
        indices,
        task.index,
        value,
        history,
        efficiency,
        task.bound,
        ceiling,
        baseline,
        0.0,
        chosen.evaluations,
        task.seed,
        task.settings.method,
        chosen.interrupted,
    )
    seconds = time.perf_counter() - began
    return replace(out, seconds=seconds)


def _ceiling(task: _Request, q: np.ndarray | None, climbs: int) -> Ceiling:
    """Return the upper bound over the candidates and the chosen poses q; over all feasible poses if `climbs` > 0.

    Args:
        task: candidates with their bound, and arguments of `select_poses`; without a search space its bound is
            returned.
        q: (m, n) chosen poses [rad or m]; None: the bound over the candidates is returned.
        climbs: number of local searches for poses that exceed the bound (`bound_over_space`).
    """
    space, joints = task.space, task.q
    if space is None or joints is None or q is None or (not climbs and np.isin(q, joints).all()):
        return Ceiling(task.bound.upper, task.bound.gap, 0, 0.0, np.zeros((0, 0)), 0)

    def report(number: int, gap: float) -> None:
        task.progress(number, number + 1, f"bound over all feasible poses, loose by {100 * gap:.2g} %")

    all_poses = np.concatenate([joints, q])
    return bound_over_space(space, all_poses, task.m, task.before, climbs=climbs, seed=task.seed, report=report)


def _value(jacobians: np.ndarray, existing: np.ndarray | None, index: Index) -> float:
    """Return the index of the chosen poses and the poses measured before, together, from their Jacobians.

    Args:
        jacobians: (m, rows, p) whitened Jacobians of the chosen poses.
        existing: (k, rows, p) those of the poses measured before; None without such poses.
        index: name of the observability index.
    """
    p = jacobians.shape[2]
    if existing is None:
        return observability(jacobians.reshape(-1, p), index, len(jacobians))
    poses = len(jacobians) + len(existing)
    past = existing.reshape(-1, p)
    stacked = np.concatenate([jacobians.reshape(-1, p), past])
    return observability(stacked, index, poses)
