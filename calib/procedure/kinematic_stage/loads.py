"""Poses and loads chosen together, so that they tell compliance besides the geometry.

    J(q, m) = [J_x, J_k (g_k + m l_k), J_k g_k],  C = (Σ JᵀJ + diag(0, 1/σ_k², 1/(μ σ_k)²))⁻¹

J_x(q) are the whitened derivatives by the geometry; J_k(q) those by a turn of element k, which carries the moments
g_k(q) of the links' gravity and l_k(q) of 1 kg at the tip. Compliances c_k [rad/N m] have a prior of the usual size
σ_k. The links' masses are known to a share μ only: the last columns are c_k times that error. Loads are known: they
tell c_k.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from calib.errors import UsageError, require
from calib.geometry.model_choice.ladder import BY_LOAD, EFFECTS
from calib.geometry.observability import Observation
from calib.geometry.observation import layout
from calib.geometry.static_torques.gravity_fit import carried_load, reference_masses
from calib.geometry.static_torques.load_errors import DESCRIBED, usual_compliance
from calib.poses.select import SearchSettings, Selection, select_poses
from calib.procedure.measuring.measuring_run import Drivable, Exchange, MeasuringRun, RunSettings, drivable, plan_run
from calib.procedure.measuring.prediction import MIN_SINGULAR, TINY, Prediction, predicted
from calib.robot.calibrated import Deflection, evaluate
from calib.robot.chain import Chain
from calib.robot.kinematics import gravity_torques

if TYPE_CHECKING:
    from calib.procedure.measuring.pose_limits import Limits


@dataclass(frozen=True, eq=False)
class CompliantObservation(Observation):
    """Whitened observation Jacobian by geometry and compliance: q (m, n) -> (m, rows, p).

    Attributes:
        payload: mass at the tip [kg].
    """

    payload: float = 0.0

    def bases(self, q: np.ndarray) -> np.ndarray:
        """Return the moments (E, m) [N m] of gravity and payload that drive the E compliances at q (m, n)."""
        chain = self.cell.chain
        return evaluate(self.cell.deflection, q, None, carried_load(chain, _payloads(self.payload, len(q))))


@dataclass(frozen=True, eq=False)
class LoadedObservation(CompliantObservation):
    """Whitened observation Jacobian by geometry, compliance, and the doubt of the links' masses.

    q (m, n) -> (m, rows, p + c); `free` are the p of geometry and compliance, of which the last c are compliances.
    """

    def __call__(self, q: np.ndarray) -> np.ndarray:
        compliances = self.free[-len(self.cell.deflection.terms) :]
        unloaded = CompliantObservation(self.cell, self.full, compliances, self.sigmas, self.reference)
        return np.concatenate([super().__call__(q), unloaded(q)], axis=2)


def _payloads(mass: float, count: int) -> np.ndarray:
    """Return a mass at the tip [kg] in `count` poses, with unstated centre, as payloads (count, 4)."""
    return np.tile([mass, np.nan, np.nan, np.nan], (count, 1))


@dataclass(frozen=True, eq=False)
class LoadOutlook:
    """What poses under several loads are predicted to tell of compliance, beside as many poses without load.

    Attributes:
        masses: (m,) load of each pose [kg], in the order of the run.
        largest: the largest load to choose from [kg].
        prior: standard deviation of each compliance before the measurement, by name [rad/N m].
        share, unloaded_share: predicted σ of compliance as a share of the prior's, geometric mean over independent
            combinations: for the chosen poses and loads, and for as many poses without load.
        loaded: prediction for the chosen poses and loads; the tool carries the largest load.
        unloaded: prediction for as many poses without load, chosen for the same purpose; the tool carries the same.
        excluded: number of pairs of pose and load that exceed a joint's largest torque.
    """

    masses: np.ndarray
    largest: float
    prior: dict[str, float]
    share: float
    unloaded_share: float
    loaded: Prediction
    unloaded: Prediction
    excluded: int

    def record(self) -> dict[str, object]:
        """Return the loads of the poses [kg], and the predicted σ of compliances [rad/N m] and tool [m] by name."""
        return {
            "masses": self.masses.tolist(),
            "compliances": list(self.prior),
            "prior": list(self.prior.values()),
            "sigma": self.loaded.sigmas[-len(self.prior) :].tolist(),
            "sigma_without_loads": self.unloaded.sigmas[-len(self.prior) :].tolist(),
            "sigma_share": self.share,
            "sigma_share_without_loads": self.unloaded_share,
            "tool_sigma_without_loads": self.unloaded.rms,
        }

    def rows(self) -> list[tuple[str, str]]:
        """Return table rows (label, text) on compliance and on the tool under the largest load."""
        shares = f"{self.share:.2g} of the usual size; {self.unloaded_share:.2g} by as many poses without load"
        errors = f"{1e3 * self.loaded.rms:.3g} mm rms; {1e3 * self.unloaded.rms:.3g} by as many poses without load"
        return [
            ("predicted σ of compliance, mean", shares),
            (f"predicted σ of the tool with {self.largest:g} kg", errors),
        ]

    def line(self) -> str:
        """Return a line of text that says which poses of the run carry which load."""
        changes = np.flatnonzero(np.diff(self.masses)) + 1
        texts = []
        for numbers in np.split(np.arange(len(self.masses)), changes):
            mass = self.masses[numbers[0]]
            carried = f"{mass:g} kg" if mass else "no load"
            texts.append(f"poses {numbers[0] + 1} to {numbers[-1] + 1} with {carried}")
        return f"loads at the tip: {', '.join(texts)}"


@dataclass(frozen=True, eq=False)
class LoadedCandidates:
    """Pairs of a pose and a load to choose from, with their Jacobians by geometry and compliance.

    Attributes:
        observations: for each load, the observation Jacobian under it.
        rows: for each load, the function q (m, n) -> whitened Jacobians (m, rows, p) of what is seen.
        masses: (L,) the loads [kg], rising.
        q: (N, n) candidate poses [rad or m].
        pose, load: (P,) pose and load of each pair, by their indices.
        jacobians: (P, rows, p) whitened Jacobians of the pairs.
        before: (k, rows, p) rows of the prior, and Jacobians of poses measured earlier without load.
        prior: standard deviation of each compliance by name [rad/N m].
    """

    observations: tuple[Observation, ...]
    rows: tuple[Callable[[np.ndarray], np.ndarray], ...]
    masses: np.ndarray
    q: np.ndarray
    pose: np.ndarray
    load: np.ndarray
    jacobians: np.ndarray
    before: np.ndarray
    prior: dict[str, float]

    def of_load(self, number: int) -> np.ndarray:
        """Return the pairs with a load, as their indices."""
        return np.flatnonzero(self.load == number)

    def jacobians_of(self, q: np.ndarray, masses: np.ndarray) -> np.ndarray:
        """Return the Jacobians (m + k, rows, p) of poses under their loads, with prior and poses measured earlier.

        Args:
            q: (m, n) the poses [rad or m].
            masses: (m,) their loads [kg], of those to choose from.
        """
        result = np.zeros((len(q), *self.jacobians.shape[1:]))
        for mass, function in zip(self.masses, self.rows):
            result[masses == mass] = function(q[masses == mass])
        return np.concatenate([result, self.before])

    def unloaded(self, rigid: Observation, limits: Limits, m: int, search: SearchSettings) -> np.ndarray:
        """Return the Jacobians (m + k, rows, p) of the m poses without load that tell geometry and compliance best.

        Args:
            rigid: the observation Jacobian by the geometry.
            limits: limits of poses.
            m: number of poses.
            search: settings of the search.
        """
        jacobians = np.asarray(limits.space(compliant(rigid, 0.0)).jacobian(self.q))
        selection = select_poses(jacobians, m, replace(search, kicks=0), existing=self.before)
        assert selection.indices is not None
        return np.concatenate([jacobians[selection.indices], self.before])


def weighed(chain: Chain) -> Chain:
    """Return an arm with its described masses; without any, with those of `reference_masses`."""
    return replace(chain, inertias=reference_masses(chain))


def without_masses(chain: Chain) -> str:
    """Return a remark on an arm whose masses nobody described; empty for others."""
    if chain.inertias is not None and chain.inertias[:, 9].any():
        return ""
    return (
        f"{chain.name} has no masses: the prediction takes 1 kg in each link; for compliance the fit needs masses, or "
        "columns of the joints' torques (tau1 …)"
    )


def compliant(rigid: Observation, mass: float) -> Observation:
    """Return the observation Jacobian by geometry and compliance under a load.

    Args:
        rigid: the observation Jacobian by the geometry.
        mass: mass at the tip [kg].
    """
    chain = weighed(rigid.cell.chain)
    terms = tuple(EFFECTS[BY_LOAD](chain, True))
    cell = replace(rigid.cell, deflection=Deflection(terms, np.zeros(len(terms)), chain))
    free = np.concatenate([rigid.free, layout(cell).index("deflection")])
    return LoadedObservation(cell, rigid.full, free, rigid.sigmas, rigid.reference, mass)


def prior_rows(observation: Observation, rows: int) -> np.ndarray:
    """Return the prior of compliance and of the masses' doubt as Jacobians (k, rows, p) of k earlier poses.

    Args:
        observation: the observation Jacobian by geometry and compliance.
        rows: number of rows of a pose.
    """
    cell = observation.cell
    terms = cell.deflection.terms
    usual = usual_compliance(cell.chain)
    numbers = [cell.chain.names.index(term.element) for term in terms]
    deviations = np.concatenate([usual[numbers], DESCRIBED * usual[numbers]])
    first = len(observation.free) - len(terms)
    count = len(deviations)
    blocks = -(-count // rows)
    result = np.zeros((blocks * rows, first + count))
    result[np.arange(count), first + np.arange(count)] = 1.0 / deviations
    return result.reshape(blocks, rows, first + count)


def loaded_candidates(
    rigid: Observation, limits: Limits, q: np.ndarray, masses: Sequence[float], existing_q: np.ndarray | None
) -> LoadedCandidates:
    """Return all pairs of a candidate pose and a load that the joints can hold.

    Args:
        rigid: the observation Jacobian by the geometry.
        limits: limits of poses.
        q: (N, n) feasible poses [rad or m].
        masses: the loads [kg].
        existing_q: (k, n) poses measured earlier without load; None without such poses.

    Raises:
        UsageError: an arm with mimic joints, or a load that no pose can hold.
    """
    chain = weighed(rigid.cell.chain)
    rigid = replace(rigid, cell=replace(rigid.cell, chain=chain))
    mimics = len(chain.driven) != chain.n
    require(not mimics, f"--loads: robot '{chain.name}' has mimic joints; leave --loads out", UsageError)
    values = np.unique(np.asarray(masses, dtype=float))
    observations = tuple(compliant(rigid, float(mass)) for mass in values)
    functions = tuple(limits.space(observation).jacobian for observation in observations)
    pose, load, jacobians = [], [], []
    for number, function in enumerate(functions):
        held = np.flatnonzero(_held(chain, q, values[number]))
        if not len(held):
            raise UsageError(
                f"--loads: {values[number]:g} kg exceeds the largest torque of a joint in each of the {len(q)} "
                "candidate poses: give a lighter load"
            )
        pose.append(held)
        load.append(np.full(len(held), number))
        jacobians.append(np.asarray(function(q[held])))
    before = prior_rows(observations[0], jacobians[0].shape[1])
    if existing_q is not None:
        earlier = np.asarray(limits.space(compliant(rigid, 0.0)).jacobian(existing_q))
        before = np.concatenate([before, earlier])
    terms = observations[0].cell.deflection.terms
    names = observations[0].cell.deflection.names(chain)
    usual = dict(zip(chain.names, usual_compliance(chain).tolist()))
    prior = {name: usual[term.element] for name, term in zip(names, terms)}
    pairs = np.concatenate(pose), np.concatenate(load), np.concatenate(jacobians)
    return LoadedCandidates(observations, functions, values, q, *pairs, before, prior)


def _held(chain: Chain, q: np.ndarray, mass: float) -> np.ndarray:
    """Return whether the joints hold a mass at the tip in each pose q (m, n) by their largest torque, (m,) bool."""
    load = carried_load(chain, _payloads(mass, len(q)))
    effort = np.array([joint.effort for joint in chain.joints])
    return np.all(np.abs(gravity_torques(chain, q, load)) <= effort, axis=1)


def loaded_run(
    chain: Chain,
    candidates: LoadedCandidates,
    selection: Selection,
    limits: Limits,
    settings: RunSettings,
    seed: int,
    progress: Callable[[str], None],
) -> Drivable:
    """Return a run through the chosen pairs, load by load; it replaces a pose that no clear path reaches.

    Args:
        chain: the arm.
        candidates: the pairs, of which `selection` has the indices.
        selection: the chosen pairs, with rising indices, thus in the order of the loads.
        limits, settings, seed, progress: as for `plan_run`.
    """
    assert selection.indices is not None
    chosen = candidates.jacobians[selection.indices]
    load = candidates.load[selection.indices]
    q = candidates.q[candidates.pose[selection.indices]]
    runs: list[Drivable] = []
    replaced: dict[int, int] = {}
    for number in np.unique(load):
        rows = np.flatnonzero(load == number)
        pairs = candidates.of_load(int(number))
        before = np.concatenate([chosen[load != number], candidates.before])
        poses = candidates.q[candidates.pose[pairs]]
        exchange = Exchange(candidates.rows[number], poses, before, selection.index)
        run = drivable(chain, q[rows], exchange, limits, settings, seed, progress)
        runs.append(run)
        chosen[rows] = candidates.rows[number](run.q)
        for index, candidate in run.replaced.items():
            replaced[int(rows[index])] = int(pairs[candidate])
    between = []
    for first, second in pairwise(runs):
        ends = np.array([first.q[first.run.order[-1]], second.q[second.run.order[0]]])
        between.append(plan_run(chain, ends, limits, settings, seed, progress))
    value = runs[0].value[0], runs[-1].value[1]
    gain = sum(run.gain for run in runs)
    return Drivable(np.concatenate([run.q for run in runs]), _joined(runs, between), replaced, value, gain)


def _joined(runs: Sequence[Drivable], between: Sequence[MeasuringRun]) -> MeasuringRun:
    """Return successive runs as one.

    Args:
        runs: the runs, each through poses of its own.
        between: runs of two poses, from the last of each run to the first of the next.
    """
    order, ways, times, blocked = [], [], [], []
    found, around, start = 0.0, 0, 0
    for number, run in enumerate(runs):
        if number:
            bridge = between[number - 1]
            if bridge.blocked:
                blocked.append(len(ways))
            path = bridge.ways[0]
            ways.append(path if bridge.order[0] == 0 else path[::-1])
            times += bridge.times.tolist()
            around += bridge.around
            found += float(bridge.times.sum())
        blocked += [len(ways) + move for move in run.run.blocked]
        ways += run.run.ways
        times += run.run.times.tolist()
        order.append(run.run.order + start)
        start += len(run.q)
        found += run.run.found
        around += run.run.around
    dwell = runs[0].run.dwell
    return MeasuringRun(np.concatenate(order), tuple(ways), np.array(times), dwell, found, around, tuple(blocked))


def load_outlook(
    candidates: LoadedCandidates, jacobians: np.ndarray, masses: np.ndarray, typical: np.ndarray, unloaded: np.ndarray
) -> LoadOutlook:
    """Return what the chosen poses and loads are predicted to tell of compliance.

    Args:
        candidates: the pairs of pose and load.
        jacobians: (m + k, rows, p) of the chosen pairs, with prior and poses measured earlier.
        masses: (m,) their loads [kg].
        typical: (s, n) joint values at which the tool's accuracy is predicted [rad or m].
        unloaded: (m + k, rows, p) of as many poses without load.
    """
    heaviest = candidates.observations[-1]
    sides = []
    for rows in (jacobians, unloaded):
        prediction = predicted(heaviest, rows, typical, len(masses))
        prediction = replace(prediction, sigmas=prediction.sigmas[: len(heaviest.free)])
        sides.append((prediction, compliance_share(rows, candidates)))
    (loaded, share), (without, unloaded_share) = sides
    excluded = len(candidates.q) * len(candidates.masses) - len(candidates.pose)
    largest = float(candidates.masses[-1])
    return LoadOutlook(masses, largest, candidates.prior, share, unloaded_share, loaded, without, excluded)


def compliance_share(jacobians: np.ndarray, candidates: LoadedCandidates) -> float:
    """Return the predicted σ of compliance as a share of the prior's, geometric mean over independent combinations.

    It is (det C_c / Π σ_k²)^(1/2c), C_c the covariance of the c compliances: 1 where the poses tell nothing.

    Args:
        jacobians: (m + k, rows, p) of the poses, with the prior.
        candidates: the pairs of pose and load, with the prior.
    """
    rows = jacobians.reshape(-1, jacobians.shape[2])
    scale = np.maximum(np.linalg.norm(rows, axis=0), TINY)
    _, singular, vt = np.linalg.svd(rows / scale, full_matrices=False)
    if singular[-1] <= MIN_SINGULAR * singular[0]:
        return 1.0
    prior = np.array(list(candidates.prior.values()))
    first = len(candidates.observations[0].free) - len(prior)
    columns = slice(first, first + len(prior))
    root = (vt.T / singular)[columns] / (scale[columns] * prior)[:, None]
    _, log_square = np.linalg.slogdet(root @ root.T)
    return float(np.exp(0.5 * log_square / len(prior)))
