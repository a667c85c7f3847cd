"""Output and input error of the simulated closed loop: the survey's CLOE and CLIE, with exact derivatives.

    CLOE    min Σ_k ‖q_k - q_s,k(χ)‖²        the simulated robot moves as the real one
    CLIE    min Σ_k ‖tau_k - tau_s,k(χ)‖²    the simulated robot's controller requires the recorded torques

q_s and tau_s are those of the simulated loop (Leboutet et al. 2021, sections 5.1 and 5.2, after Landau
1979; Gautier, Janot & Vandanjon 2013), and each joint is weighted by its residuals. With joint torque sensors (rows
link, both) both methods also compare the sensors' torques, which are outputs of the loop: simulated torques are those
of the bodies and the link side along the simulated motion, filtered like the recorded motion (our choice).

Damped Gauss–Newton steps need ∂q_s/∂χ and ∂tau_s/∂χ. Here these are the tangents of the simulation, computed in one
pass (`tangent_kernels`); differences, which parallel robots use, need one simulation per parameter. Torques of
redundant actuators are compared in the platform's coordinates, as in least squares. The residuals are the effect of
noise in the loop and autocorrelated; the covariance H⁻¹ S H⁻¹ accounts for this, with S the covariance of the gradient
(`score_covariance`).

The source simulates without noise. If the torques show noise in the recording's loop (`sign_noise`), the mean of two
runs with opposite noise is taken here, because an arm that shakes has less Coulomb friction in the mean (our choice).
Robots without tangents are simulated without noise.

The method that some slides call CLIE, (ZᵀZ)⁻¹Zᵀy with Z the simulated observation matrix, is DIDIM in the survey and
here.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import scipy.linalg

from calib.data.signals.filtering import decimate
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.torque_rows import BODIES, LINK, TorqueRows
from calib.errors import CalibError, NotConverged, UsageError
from calib.estimation import nonlinear
from calib.estimation.linear import LinearFit
from calib.estimation.triangles import condition_numbers, require_rank
from calib.identification.closed_loop.loop_recordings import (
    ClosedLoops,
    Loop,
    close_loops,
    followed,
    low_passed,
    simulated_samples,
)
from calib.identification.closed_loop.sign_noise import SEED, position_noise
from calib.identification.closed_loop.simulated import attempted_in_loop
from calib.identification.closed_loop.simulation import Plant, Sensing
from calib.identification.loop import LoopController
from calib.identification.methods.least_squares import WLS
from calib.identification.methods.method import EstimateStatus, IdentificationProblem, Method, MethodEstimate
from calib.identification.rows import Case, thinned
from calib.identification.survey.score_covariance import scatter
from calib.identification.survey.simulated_robot import BelievedRobot, Sensitivities, believed_robot, start_of
from calib.records import field_values


@dataclass(frozen=True)
class _OutputError(Method):
    """Identification that fits the simulated closed loop to the recordings.

    Attributes:
        torques: whether torques are compared (CLIE) instead of positions (CLOE).
    """

    needs_controller: bool = field(default=True, kw_only=True)
    needs_simulation: bool = field(default=True, kw_only=True)
    takes_start: bool = field(default=True, kw_only=True)
    auto_friction: str = field(default="standard", kw_only=True)
    tunes: tuple[str, ...] = field(default=("damping", "tolerance 0.05 sigma"), kw_only=True)
    torques: bool

    def takes(self, rows: TorqueRows) -> bool:
        """Return whether the method supports these torque rows.

        CLIE does not support sensor torques alone, since these do not identify the motion of the motors.
        """
        return super().takes(rows) and (not rows.sensed or rows.with_motors or not self.torques)

    def estimate(self, problem: IdentificationProblem) -> MethodEstimate:
        """Return the estimate of the problem's parameters.

        Raises:
            UsageError, MeasurementError: for a loop or recordings that cannot be simulated.
        """
        if problem.loop is None:
            raise UsageError(f"method '{self.name}' needs a [loop], and a robot that can be simulated")
        plain = WLS.estimate(problem)
        if not plain.found:
            return replace(plain, method=self.name)
        # of the differences of a robot without tangents, in standard deviations (our choice)
        step = 0.01
        steps = step * np.asarray(plain.estimate.sigma)
        robot = believed_robot(problem, self, steps)
        loops = close_loops(robot.model, problem.cases, problem.decimator, problem.loop, problem.cad)
        task = _Comparison(problem, robot, loops, self.torques)
        return attempted_in_loop(self.name, problem, loops, lambda: self._estimate(problem, plain, task))

    def _estimate(self, problem: IdentificationProblem, plain: MethodEstimate, task: _Comparison) -> MethodEstimate:
        loops = task.loops
        with np.errstate(divide="ignore", invalid="ignore"):
            inertia = loops.controller.kd**2 / (2.0 * loops.controller.kp)
        inertia = np.where(np.isfinite(inertia) & (inertia > 0.0), inertia, 1.0)
        values = start_of(problem, plain.estimate.values, inertia, lambda x: task.simulated(task.whole(x, inertia)))
        values = task.whole(values, inertia)
        task = task.with_noise(values)
        first, _ = task.linearised(values)
        std = task.spread(first, 0)
        count = 1
        # of weighing joints by what the last estimate leaves
        max_rounds = 3
        rounds = 0
        while True:
            rounds += 1
            solution = task.solved(values, std)
            values = solution.state
            count = count + solution.iterations
            residual, slopes = task.linearised(values)
            before = std
            std = task.spread(residual, len(values))
            if rounds == max_rounds or np.all(np.abs(std / before - 1.0) < 0.1):
                break
        fit = _packed(task, plain, values, residual, slopes, std)
        step = np.linalg.norm(_gradient(residual / std, slopes / std[:, None]))
        if not solution.status.good and step > 0.5:
            raise NotConverged(
                f"{self.name}: {solution.status.value} ({step:.2g} standard deviations in the last step)", fit
            )
        simulations = task.count[0]
        return replace(
            plain,
            method=self.name,
            status=EstimateStatus.FOUND,
            solution=fit,
            std=std if self.torques else plain.std,
            iterations=count,
            simulations=simulations,
            beforehand=None,
            alone=True,
        )


@dataclass(frozen=True, eq=False)
class _Comparison:
    """Comparison of simulated with recorded signals of all closed loops.

    Residuals and Jacobians have r columns: first the torque sensors, if the problem has any, then n positions or motor
    torques.

    Attributes:
        problem: data and settings.
        robot: the simulated robot.
        loops: closed loops of the recordings.
        torques: whether motor torques are compared instead of positions.
        count: number of simulations so far, in a list of one entry.
        noise: (N, n) noise of the measured positions in each loop [rad or m], drawn once; None for loops without,
            no entries for none.
    """

    problem: IdentificationProblem
    robot: BelievedRobot
    loops: ClosedLoops
    torques: bool
    count: list[int] = field(default_factory=lambda: [0])
    noise: tuple[np.ndarray | None, ...] = ()

    @property
    def rows(self) -> TorqueRows:
        """Torque rows of the problem's model."""
        return self.problem.model.torque_rows

    def whole(self, values: np.ndarray, inertia: np.ndarray) -> np.ndarray:
        """Return the parameters (p + k,) of the simulated robot.

        They are the problem's parameters and, if the problem has no motor torques, k parameters of the motors.

        Args:
            values: (p,) parameters of the problem.
            inertia: (n,) first inertias of the motors [kg m² or kg]; their first friction is zero.
        """
        motors = np.zeros(len(self.robot.columns) - len(values))
        stride = max(1, len(motors) // len(inertia))
        motors[::stride] = inertia[: len(motors)]
        return np.append(values, motors)

    def simulated(self, values: np.ndarray) -> None:
        """Simulate all loops with parameters (p,), to check that this is possible.

        Args:
            values: (p,) parameters of the problem.

        Raises:
            CalibError: if a loop cannot be simulated.
        """
        for case, loop in self.loops.pairs:
            plant = self.robot.at(values, case)
            controller = loop.controller
            if loop.design is not None:
                diagonal = plant.inertia_diagonal(loop.reference.q[::200])
                controller = controller.scaled(diagonal / loop.design)
            self.count[0] += 1
            plant.run(controller, loop.reference, Sensing(every=loop.every))

    def linearised(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return residuals (M, r), zero if not in use, and the Jacobian (M, r, p) of the simulated signals.

        Args:
            values: (p,) parameters, at which the signals are simulated.
        """
        residuals = []
        slopes = []
        noise = self.noise or (None,) * len(self.loops.pairs)
        for (case, loop), drawn in zip(self.loops.pairs, noise, strict=True):
            plant = self.robot.at(values, case)
            controller = loop.controller
            relative = None
            if loop.design is not None:
                diagonal = plant.inertia_diagonal(loop.reference.q[::200])
                controller = controller.scaled(diagonal / loop.design)
                relative = self._inertia_slopes(loop.reference.q[::200]) / diagonal[:, None]
            run = self._mean_run(values, case, controller, loop, relative, drawn)
            index = simulated_samples(case, run.t, loop)
            motion = case.motion
            # Residuals and their slopes, in the order of the rows.
            parts = []
            if self.rows.sensed:
                parts.append(self._sensed(plant, case, run, index))
            if not self.torques:
                position = low_passed(run.q, motion)[index]
                slope = low_passed(run.by_q, motion)[index]
                parts.append((motion.q - position, slope))
            elif self.rows.projection is not None:
                torques = np.dstack([run.torque, run.by_torque])[index]
                acts = [BODIES] * torques.shape[2]
                observed = self.rows.observe(torques, acts, motion.q, motion.v)
                residual = case.target - observed[:, :, 0]
                parts.append((residual, observed[:, :, 1:]))
            elif self.rows.with_motors:
                measured_torque = case.target[:, -motion.n :]
                parts.append((measured_torque - run.torque[index], run.by_torque[index]))
            residual = np.concatenate([part_residual for part_residual, _ in parts], axis=1)
            slope = np.concatenate([part_slope for _, part_slope in parts], axis=1)
            joint_count = min(motion.n, case.present.shape[1])
            joints = np.arange(residual.shape[1]) % joint_count
            present = case.present[:, joints]
            in_use = thinned(present, motion.segment, self.problem.decimator)
            residual = decimate(residual, self.problem.decimator, motion.segment)
            slope = decimate(slope, self.problem.decimator, motion.segment)
            residuals.append(np.where(in_use, residual, 0.0))
            slopes.append(np.where(in_use[:, :, None], slope, 0.0))
        return np.concatenate(residuals), np.concatenate(slopes)

    def with_noise(self, values: np.ndarray) -> _Comparison:
        """Return the comparison with the recordings' noise in the loop, as their torques answer it.

        Args:
            values: (p,) parameters with which the loops are simulated.
        """
        if self.robot.steps is not None:
            return replace(self, noise=(None,) * len(self.loops.pairs))
        noise: list[np.ndarray | None] = []
        for case, loop in self.loops.pairs:
            sigma = position_noise(self.robot.at(values), case, loop).loop
            drawn = np.random.default_rng(SEED).normal(size=loop.reference.q.shape) * sigma
            if np.any(sigma):
                noise.append(drawn)
            else:
                noise.append(None)
        return replace(self, noise=tuple(noise))

    def _mean_run(
        self,
        values: np.ndarray,
        case: Case,
        controller: LoopController,
        loop: Loop,
        relative: np.ndarray | None,
        drawn: np.ndarray | None,
    ) -> Sensitivities:
        """Return the mean of runs with noise `drawn` in the loop and with its opposite; one run where there is none.

        Args:
            values: (p,) parameters of the problem.
            case: the recording, which has the payloads.
            controller: controller of the robot.
            loop: loop of the recording.
            relative: (n, p) derivatives of the logarithm of the gains by the parameters; None: the gains are constant.
            drawn: (N, n) noise of the measured positions [rad or m]; None for no noise.
        """
        self.count[0] += 1
        first = self.robot.sensitivities(values, case, controller, loop.reference, loop.every, relative, drawn)
        if drawn is None:
            return first
        self.count[0] += 1
        second = self.robot.sensitivities(values, case, controller, loop.reference, loop.every, relative, -drawn)
        means = {}
        for name, value in field_values(first).items():
            means[name] = 0.5 * (value + getattr(second, name))
        return Sensitivities(**means)

    def _sensed(self, plant: Plant, case: Case, run: Sensitivities, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return residuals (N, n) of the sensors' torques [N m or N], and the Jacobian (N, n, p) of simulated torques.

        Args:
            plant: the simulated robot.
            case: the recording.
            run: simulated motion with its derivatives.
            index: (N,) indices of the simulated samples at the recorded times.
        """
        link = IdentificationModel(plant.bodies, plant.terms, LINK)
        link_columns = list(range(plant.inertial))
        link_columns += [column for column, term in enumerate(plant.terms, plant.inertial) if term in link.columns]
        position = np.full(len(plant.parameters), -1)
        position[link_columns] = np.arange(len(link_columns))
        columns = position[self.robot.columns]
        values = plant.parameters[link_columns]
        states = followed(run.q, case.motion, index)
        slopes = followed(run.by_q, case.motion, index)
        regressor = link.regressor(*states, None, case.carried)
        jacobian = np.where(columns >= 0, regressor[:, :, columns], 0.0)
        for row in np.eye(case.motion.n, dtype=bool):
            weights = np.tile(row, (len(index), 1)) * 1.0
            for by, slope in zip(link.torque_gradient(*states, values, weights), slopes):
                jacobian[:, row] += np.einsum("kj,kjc->kc", by, slope)[:, None]
        return case.target[:, : case.motion.n] - regressor @ values, jacobian

    def _inertia_slopes(self, q: np.ndarray) -> np.ndarray:
        """Return the derivatives (n, p) of the inertia matrix's diagonal by the parameters.

        The diagonal is the mean over joint positions q (N, n).
        """
        units = np.eye(len(self.robot.columns))
        diagonals = [self.robot.at(unit).inertia_diagonal(q) for unit in units]
        return np.array(diagonals).T

    def whitened(self, values: np.ndarray, std: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return residuals (M r,) and Jacobian (M r, p), divided by std (r,).

        If the simulation fails, the residuals are huge and the Jacobian is zero.

        Args:
            values: (p,) parameters, at which the signals are simulated.
            std: (r,) standard deviations of the residuals.
        """
        p = len(values)
        # residual of parameters that cannot be simulated: any step that can is better
        impossible = 1e60
        try:
            residual, slopes = self.linearised(values)
        except CalibError:
            return np.full(p + 1, impossible), np.zeros((p + 1, p))
        scaled_slopes = (slopes / std[:, None]).reshape(-1, p)
        return (residual / std).ravel(), np.asfortranarray(scaled_slopes)

    def solved(self, values: np.ndarray, std: np.ndarray) -> nonlinear.Solution[np.ndarray]:
        """Return the parameters that minimise the residuals divided by std (r,), with convergence.

        Args:
            values: (p,) first parameters.
            std: (r,) standard deviations of the residuals.
        """
        # at first
        first_damping = 1e-3
        # simulations with tangents per round
        max_simulations = 25
        # standard deviations of the estimate
        step_tolerance = 0.05

        def linearise(x: np.ndarray) -> nonlinear.Reduced:
            residual, slopes = self.whitened(x, std)
            rms = float(np.sqrt(np.mean(residual**2)))
            compared = "torques" if self.torques else "positions"
            self.problem.say(f"{compared} compared after {self.count[0]} simulations: residual {rms:.4g} σ")
            return nonlinear.triangle(residual, slopes)

        def moved(x: np.ndarray, step: np.ndarray) -> np.ndarray:
            return x + step

        return nonlinear.solve(
            linearise, moved, values, damping=first_damping, tolerance=step_tolerance, limit=max_simulations
        )

    def spread(self, residual: np.ndarray, p: int) -> np.ndarray:
        """Return the standard deviation (r,) of each column of residuals (M, r), after a fit of p parameters."""
        count = np.maximum(np.sum(residual != 0.0, axis=0), 1)
        share = max(1.0 - p / count.sum(), 0.1)
        std = np.sqrt(np.sum(residual**2, axis=0) / count / share)
        n = self.problem.cases[0].motion.n
        # of torques and of positions: other units
        kinds = [std[k : k + n] for k in range(0, len(std), n)]
        positive = []
        for kind in kinds:
            largest = max(float(kind.max()), 1e-300)
            positive.append(np.maximum(kind, 1e-6 * largest))
        return np.concatenate(positive)


def _gradient(residual: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    """Return the next Gauss–Newton step Qᵀ r (p,), in standard deviations of the estimate for white residuals.

    Args:
        residual: (M, r) residuals divided by their standard deviations.
        slopes: (M, r, p) their Jacobian.
    """
    p = slopes.shape[2]
    flat = slopes.reshape(-1, p)
    orthonormal, _ = np.linalg.qr(flat)
    return orthonormal.T @ residual.ravel()


def _packed(
    task: _Comparison,
    plain: MethodEstimate,
    values: np.ndarray,
    residual: np.ndarray,
    slopes: np.ndarray,
    std: np.ndarray,
) -> LinearFit:
    """Return the fit of parameters, residuals and Jacobian, with the covariance H⁻¹ S H⁻¹.

    Args:
        task: the comparison.
        plain: the least-squares estimate, for names and units.
        values: (p,) parameters.
        residual, slopes: (M, r) residuals and (M, r, p) Jacobian.
        std: (r,) standard deviations of the residuals [rad, m, N m or N].

    Raises:
        Unidentifiable: if the simulated motion does not distinguish parameters.
    """
    white = slopes / std[:, None]
    white_residual = residual / std
    p = len(values)
    rows = int(np.sum(residual != 0.0))
    count = len(plain.pooled.names)
    plant = task.robot.plant
    # Those of the motors follow, where the problem has none of them.
    motor_terms = [plant.terms[column - plant.inertial] for column in task.robot.columns[count:]]
    names = (*plain.pooled.names, *[term.name for term in motor_terms])
    flat = white.reshape(-1, p)
    size = np.linalg.norm(flat, axis=0)
    safe_size = np.where(size > 0.0, size, 1.0)
    factor = np.asarray(np.linalg.qr(flat / safe_size, mode="r"))
    require_rank(factor, names, "the simulated motion does not distinguish them")
    inverse = scipy.linalg.solve_triangular(factor, np.eye(p)) / size[:, None]
    bread = inverse @ inverse.T
    covariance = rows / max(rows - p, 1) * bread @ scatter(white, white_residual) @ bread
    rounds = 5
    for _ in range(rounds):
        covariance = bread @ scatter(white, white_residual, covariance) @ bread
    covariance = covariance[:count, :count]
    estimate = replace(plain.estimate, values=values[:count], covariance=covariance, residual_std=1.0)
    return LinearFit(estimate, std, *condition_numbers(flat))


_LOOP = "controller and reference are those of [loop], the robot has the model's friction; "
CLOE = _OutputError(
    "cloe",
    _LOOP + "measured motor torques are not used",
    False,
    source="Landau 1979; Leboutet et al. 2021",
    description="closed-loop output error: simulated positions are fitted to measured ones",
)
CLIE = _OutputError(
    "clie",
    _LOOP + "measured positions are not used",
    True,
    source="Leboutet et al. 2021",
    description="closed-loop input error: simulated torques are fitted to measured ones",
)
