"""The survey's nonlinear Kalman filters on the direct dynamic model, with parameters as states.

    state x = [q, v, χ],   q, v ← one step under the measured torques with parameters χ,   χ ← χ,   measured: q

(Gautier & Poignet 2001; Leboutet et al. 2021, section 6.1). The filter makes one pass over all recordings. The robot
alone is simulated, so that no controller is needed. Settings that the survey tunes by hand are determined by the data
or follow from the model (our choices):

* Noise of q: the level of each log's spectrum; the filtered log is decimated to `rate_factor` times its cut-off.
* Process noise: that of the torques, from the residuals of weighted least squares, through ½ T² M⁻¹ and T M⁻¹.
* Parameters have no process noise: they are constants, and a filter with correct other noise needs none to converge.
* Start values of the parameters are those of `simulated_robot.start_of`. Their standard deviation is `start_sigmas`
  times that of least squares, or their distance from least squares if that is larger: little information compared with
  that of a pass.

If innovations are larger than the filter predicts, the covariance is multiplied by their mean square.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from calib.errors import CalibError, CannotSimulate, Diverged, require
from calib.estimation.linear import LinearFit
from calib.identification.closed_loop.loop_recordings import low_passed
from calib.identification.closed_loop.simulation import forward_dynamics
from calib.identification.methods.least_squares import WLS
from calib.identification.methods.method import EstimateStatus, IdentificationProblem, Method, MethodEstimate, attempted
from calib.identification.rows import Case, segments
from calib.identification.survey.kalman import Belief, Filter, believe, corrected, linearly_predicted, points, predicted
from calib.identification.survey.simulated_robot import BelievedRobot, Stepper, believed_robot, start_of, stepper

# of a rule's points, where the wider ones are no robots
NARROWER = (1.0, 0.5, 0.25, 0.1, 0.03)


@dataclass(frozen=True)
class _KalmanFilter(Method):
    """Identification by a Kalman filter whose states include the parameters.

    Attributes:
        kind: rule of the filter, and form of its covariance.
    """

    needs_simulation: bool = field(default=True, kw_only=True)
    takes_start: bool = field(default=True, kw_only=True)
    auto_friction: str = field(default="standard", kw_only=True)
    takes_models: bool = field(default=False, kw_only=True)
    kind: Filter

    def estimate(self, problem: IdentificationProblem) -> MethodEstimate:
        """Return the estimate of the parameters after the last sample.

        Args:
            problem: data and settings.

        Raises:
            UsageError: for a model other than a serial arm with motor torques.
        """
        plain = WLS.estimate(problem)
        if not plain.found:
            return replace(plain, method=self.name)
        return attempted(self.name, problem, lambda: self._estimate(problem, plain, believed_robot(problem, self)))

    def _estimate(self, problem: IdentificationProblem, plain: MethodEstimate, robot: BelievedRobot) -> MethodEstimate:
        values = plain.estimate.values
        sigma = plain.estimate.sigma
        inertia = _inertia(problem)
        start = start_of(problem, values, inertia, lambda x: _moves(robot, problem, x))
        # standard deviations of least squares that the parameters are uncertain by at first
        start_sigmas = 5.0
        wide = np.maximum(start_sigmas * sigma, np.abs(start - values))
        # of one sample of the torques
        noise = plain.std / np.sqrt(np.sum(np.square(problem.decimator.taps)))
        covariance = np.diag(wide**2)
        state = _State(robot, self.kind, start, covariance, [], 0)
        for case in problem.cases:
            for first, last in segments(case.motion.segment):
                part = slice(first, last)
                state = _pass(state, case, part, noise)
        if state.sizes:
            innovation = float(np.mean(state.sizes))
        else:
            innovation = np.inf
        # times the stated mean square: innovations of a filter that has lost the robot
        max_innovation = 30.0
        if not np.isfinite(innovation) or innovation > max_innovation:
            raise Diverged(
                f"{self.name} diverged: its innovations are {np.sqrt(innovation):.3g} times the predicted ones; use "
                "another method",
                state.mean,
            )
        covariance = max(1.0, innovation) * state.covariance
        estimate = replace(plain.estimate, values=state.mean, covariance=covariance, residual_std=1.0)
        fit = LinearFit(estimate, plain.std, plain.fit.condition, plain.fit.condition_normalised)
        return replace(
            plain,
            method=self.name,
            status=EstimateStatus.FOUND,
            solution=fit,
            iterations=1,
            simulations=state.count,
            beforehand=None,
            alone=True,
        )


@dataclass(frozen=True, eq=False)
class _State:
    """Parameters of the filter between recordings.

    Attributes:
        robot: the simulated robot.
        kind: rule of the filter, and form of its covariance.
        mean, covariance: (p,) and (p, p) of the parameters.
        sizes: sizes of past innovations.
        count: number of segments processed.
    """

    robot: BelievedRobot
    kind: Filter
    mean: np.ndarray
    covariance: np.ndarray
    sizes: list[float]
    count: int


def _inertia(problem: IdentificationProblem) -> np.ndarray:
    """Return the mean inertia (n,) of each joint, from the regression of its torque on its acceleration.

    Args:
        problem: data and settings, with the recordings.
    """
    n = problem.cases[0].motion.n
    cross = np.zeros(n)
    size = np.full(n, 1e-12)
    for case in problem.cases:
        a = case.motion.a - case.motion.a.mean(axis=0)
        tau = case.target - case.target.mean(axis=0)
        cross += np.sum(a * tau, axis=0)
        size += np.sum(a**2, axis=0)
    ratio = cross / size
    return np.maximum(ratio, 0.1 * np.max(np.abs(cross) / size))


def _moves(robot: BelievedRobot, problem: IdentificationProblem, values: np.ndarray) -> None:
    """Compute accelerations along the recordings, to check that a robot with parameters `values` can be simulated.

    Args:
        robot: model that is simulated.
        problem: data and settings, with the recordings.
        values: (p,) parameters.

    Raises:
        CalibError: if it cannot.
    """
    for case in problem.cases:
        part = slice(None, None, max(1, len(case.motion) // 200))
        q = case.motion.q[part]
        v = case.motion.v[part]
        forward_dynamics(robot.at(values, case), q, v, np.zeros_like(q))


def samples_with_torques(case: Case, part: slice, max_step: float = 2.5e-3) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the samples that the filter uses, with the torques between them.

    Each is a position q (n,), and the mean torques (s, n) in s equal time steps since the last sample.

    Args:
        case: the recording.
        part: slice of a gap-free segment.
        max_step: longest time step of the dynamics [s].
    """
    motion = case.motion
    thin = thinning_factor(case)
    # as the positions were: the same band on both sides
    q = motion.q[part]
    tau = low_passed(case.target[part], motion)
    means = 0.5 * (tau[1:] + tau[:-1])
    cumulated_means = np.cumsum(means, axis=0)
    cumulated = np.concatenate([np.zeros((1, motion.n)), cumulated_means])
    steps = max(1, int(np.ceil(thin / (motion.rate * max_step) - 1e-6)))
    indices = np.arange(len(q), dtype=float)
    for k in range(thin, len(q), thin):
        ends = np.linspace(k - thin, k, steps + 1)
        window = slice(k - thin, k + 1)
        joint_sums = [np.interp(ends, indices[window], joint) for joint in cumulated[window].T]
        sums = np.column_stack(joint_sums)
        yield q[k], np.diff(sums, axis=0) * (steps / thin)


def thinning_factor(case: Case, rate_factor: float = 4.0) -> int:
    """Return the number of samples of a recording per sample that the filter uses.

    Args:
        case: the recording.
        rate_factor: least rate of the filter, as a multiple of the positions' cut-off.
    """
    max_rate = rate_factor * float(case.motion.cutoff.max())
    return max(1, int(case.motion.rate / max_rate))


def _pass(before: _State, case: Case, part: slice, noise: np.ndarray) -> _State:
    """Return the filter's parameters after a segment of a recording; unchanged if the segment is too short.

    Args:
        before: parameters before the segment.
        case: the recording.
        part: slice of the segment.
        noise: (n,) standard deviation of the torque noise of a sample [N m or N].
    """
    motion = case.motion
    thin = thinning_factor(case)
    n = case.motion.n
    if part.stop - part.start <= 2 * thin:
        return before
    columns = before.robot.columns
    p = len(before.mean)
    plant = before.robot.at(before.mean, case)
    robot_stepper = stepper(plant, columns)
    carried = before.robot.carried(case)
    least_noise = 1e-9 * np.ptp(motion.q, axis=0).max()
    position_noise = np.maximum(motion.cutoffs.noise / np.sqrt(thin), least_noise)
    period = thin / motion.rate
    torque = noise * np.sqrt(1.0 / thin)
    slow = 1e-3 * np.abs(motion.v).max(axis=0)
    moving = np.maximum(motion.velocity_noise(), slow)
    first = np.concatenate([motion.q[part.start], motion.v[part.start], before.mean])
    first_sigma = np.concatenate([position_noise, moving, np.ones(p)])
    belief = believe(first, first_sigma, before.kind)
    spread = _joined(belief, before.covariance, 2 * n)
    belief = replace(belief, spread=spread)
    parameter_count = len(before.robot.plant.parameters)
    full = _Stepping(robot_stepper, before.kind, n, parameter_count, columns, carried)
    sizes = []
    for q, tau in samples_with_torques(case, part):
        belief = full.step(belief, np.ascontiguousarray(tau), period / len(tau), torque)
        belief, size = corrected(belief, q, n, position_noise)
        require(
            np.isfinite(size),
            "the filter diverged: its estimate is not finite; use another method",
            Diverged,
            belief.mean,
        )
        sizes.append(size / n)
    settled = sizes[len(sizes) // 4 :]
    mean = belief.mean[2 * n :]
    covariance = belief.covariance[2 * n :, 2 * n :]
    all_sizes = [*before.sizes, *settled]
    count = before.count + 1
    return replace(before, mean=mean, covariance=covariance, sizes=all_sizes, count=count)


def _joined(belief: Belief, parameters: np.ndarray, first: int) -> np.ndarray:
    """Return a belief's spread (covariance or its root) with the block of the parameters replaced.

    Args:
        belief: mean and covariance of the state.
        parameters: (p, p) covariance of the parameters.
        first: index of the first parameter in the state.
    """
    spread = np.array(belief.spread)
    if belief.root:
        spread[first:, first:] = np.linalg.cholesky(parameters)
    else:
        spread[first:, first:] = parameters
    return spread


@dataclass(frozen=True, eq=False)
class _Stepping:
    """Prediction step of a filter, with the simulated robot.

    Attributes:
        stepper: robot that is advanced in time.
        kind: rule of the filter, and form of its covariance.
        n: number of joints.
        size: number of the simulated robot's parameters.
        columns: indices of those parameters that are states.
        carried: factors of these parameters: 0 for payloads that are not attached, otherwise 1.
    """

    stepper: Stepper
    kind: Filter
    n: int
    size: int
    columns: np.ndarray
    carried: np.ndarray

    def step(self, before: Belief, tau: np.ndarray, period: float, torque: np.ndarray) -> Belief:
        """Return the predicted belief after torques tau (s, n), each held for one period.

        Args:
            before: belief before the step.
            tau: (s, n) torques [N m or N].
            period: duration of each torque [s].
            torque: (n,) standard deviation of the torque noise [N m or N].

        Raises:
            CannotSimulate: if not even sigma points near the mean can be simulated.
        """
        n = self.n
        if self.kind.rule == "ekf":
            mean = np.array(before.mean)
            values = self._values(before.mean[None])[0]
            slopes = np.eye(len(mean))
            gain = np.eye(n)
            for torques in tau:
                q = mean[:n]
                v = mean[n : 2 * n]
                outcome = self.stepper.linearised(values, q, v, torques, period, len(self.columns))
                mean[:n], mean[n : 2 * n], gain, part = outcome
                part[:, 2 * n :] *= self.carried
                slopes[: 2 * n] = part[:, : 2 * n] @ slopes[: 2 * n]
                slopes[: 2 * n, 2 * n :] += part[:, 2 * n :]
            noise = self._noise(gain, len(tau) * period, torque, len(mean))
            return linearly_predicted(before, mean, slopes, noise, self.kind)
        failure: CalibError | None = None
        for narrower in NARROWER:
            spread = points(before, self.kind, narrower)
            values = self._values(spread)
            q = spread[:, :n]
            v = spread[:, n : 2 * n]
            gain = np.eye(n)
            try:
                for torques in tau:
                    q, v, gain = self.stepper.points(values, q, v, torques, period)
            except CalibError as error:
                failure = error
                continue
            spread[:, :n], spread[:, n : 2 * n] = q, v
            noise = self._noise(gain, len(tau) * period, torque, spread.shape[1])
            return predicted(spread, noise, self.kind, narrower)
        raise CannotSimulate(f"a robot with the filter's parameters cannot be simulated: {failure}", before.mean)

    def _values(self, states: np.ndarray) -> np.ndarray:
        """Return the simulated robot's parameters (K, p) for states (K, L) of the filter."""
        result = np.zeros((len(states), self.size))
        result[:, self.columns] = states[:, 2 * self.n :] * self.carried
        return result

    def _noise(self, gain: np.ndarray, period: float, torque: np.ndarray, size: int) -> np.ndarray:
        """Return the effect N (L, n) of torque noise on the state during one step, with L = `size`.

        Args:
            gain: (n, n) M⁻¹, inverse of the inertia matrix.
            period: duration of the step [s].
            torque: (n,) standard deviation of the torque noise.
            size: number L of components of the state.
        """
        result = np.zeros((size, self.n))
        result[: self.n] = 0.5 * period**2 * gain * torque
        result[self.n : 2 * self.n] = period * gain * torque
        return result


_ASSUMES = (
    "torque noise as in the residuals of least squares, position noise as in the spectrum, both white; "
    "the robot has the model's friction"
)
_TUNED = ("initial covariance of the parameters", "rate of the filter")
_DESCRIPTIONS = {
    "ekf": "extended Kalman filter, parameters as states",
    "ukf": "unscented Kalman filter, parameters as states",
    "cdkf": "central-difference Kalman filter, parameters as states",
}


def _filter(rule: str, source: str) -> _KalmanFilter:
    """Return the method of a rule in the form that stores the covariance.

    Args:
        rule: ``ekf``, ``ukf`` or ``cdkf``.
        source: authors and year.
    """
    tuned = (*_TUNED, "α = 0.1") if rule == "ukf" else _TUNED
    description = _DESCRIPTIONS[rule]
    return _KalmanFilter(rule, _ASSUMES, Filter(rule, False), source=source, description=description, tunes=tuned)


def _root_filter(plain: _KalmanFilter, source: str) -> _KalmanFilter:
    """Return the square-root form of a filter method, which stores the root of the covariance.

    Args:
        plain: the method that stores the covariance.
        source: authors and year of the square-root form.
    """
    root = Filter(plain.kind.rule, True)
    return replace(plain, name=f"sr{plain.name}", kind=root, source=source, description="the same, square-root form")


EKF = _filter("ekf", "Gautier & Poignet 2001")
SREKF = _root_filter(EKF, "Kaminski, Bryson & Schmidt 1971")
UKF = _filter("ukf", "Julier & Uhlmann 2004")
SRUKF = _root_filter(UKF, "van der Merwe & Wan 2001")
CDKF = _filter("cdkf", "Nørgaard, Poulsen & Ravn 2000")
SRCDKF = _root_filter(CDKF, "van der Merwe & Wan 2001")
