"""Is least squares biased? The loop a recording came from, simulated, says so, and offers the estimate that is not.

`disagreement` compares estimates that take a loop for granted with those that do not, on the same rows.

CLOE and CLIE fit a simulated loop; what of the loop is stated wrongly goes into their parameters, and no residual need
tell: half a period's delay of a velocity is just kd / (2 rate) more inertia. Instruments need the loop but roughly, and
least squares not at all. Noise of the positions biases least squares, so parameters alone decide nothing: the recorded
torques must side against the loop as well, beside simulated motion, which is free of noise.
"""

from dataclasses import dataclass

import numpy as np

from calib.errors import CalibError, Finding, finding
from calib.identification.loop.loop_recordings import ClosedLoops
from calib.identification.methods.instrumental import Instrumental
from calib.identification.methods.least_squares import WLS
from calib.identification.methods.method import IdentificationProblem, MethodEstimate
from calib.identification.methods.simulated import IV

MAX_SHIFT_SIGMAS = 3.0  # standard deviations of a shift that does not matter, however surely it is there (our choice)


@dataclass(frozen=True, eq=False)
class LoopTest:
    """What instruments from simulation came to.

    Attributes:
        found: their estimate of the standard model, with the test of least squares; None where there is none.
        loops: what was simulated.
        failure: why there is no estimate.
    """

    found: Instrumental | None = None
    loops: ClosedLoops | None = None
    failure: str = ""

    def findings(self, taken: bool) -> list[Finding]:
        """Return what a user should know who took this estimate, or (`taken` False) one of least squares."""
        if self.failure:
            return [finding("loop-test-failed", why=self.failure)]
        if self.found is None:
            return []
        noticed = [*_weakness(self.found), *(_distance(self.found) or _gains(self.found))]
        return noticed + (_blurred(self) if taken else _biased(self.found))


def compare_with_loop(problem: IdentificationProblem, estimate: MethodEstimate) -> LoopTest:
    """Return what instruments from simulation say of an estimate's problem; nothing without a loop.

    An estimate that came from them is the comparison itself; beside another method's, their failure is reported.
    """
    if problem.loop is None:
        return LoopTest()
    if estimate.instrumental is None:
        try:
            estimate = IV.beside(problem, estimate)
        except CalibError as error:
            return LoopTest(failure=str(error))
    return LoopTest(estimate.instrumental, estimate.loops, "" if estimate.found else str(estimate.failure))


def _weakness(found: Instrumental) -> list[Finding]:
    strength = found.strength
    if not strength.weak:
        return []
    least = np.argsort(strength.partial_r2)[:5]
    names = [f"{strength.names[k]} ({100 * strength.partial_r2[k]:.2g} %)" for k in least]
    return [finding("weak-instruments", donald=strength.cragg_donald, names=names)]


def _distance(found: Instrumental) -> list[Finding]:
    max_miss = 10.0  # [%] of a joint's motion by which the simulated robot may miss the recorded one (our choice)
    joints = [f"{x:.3g} % at joint {j + 1}" for j, x in enumerate(found.distance) if not x < max_miss]
    return [finding("loop-not-followed", joints=joints)] if joints else []


def _gains(found: Instrumental) -> list[Finding]:
    """Name the joints whose gains are not those of the recording: all that the simulated robot did was to follow."""
    joints = [f"{found.stray[j]:.2g} times at joint {j + 1}" for j in found.off]
    return [finding("loop-gains-off", joints=joints)] if joints else []


def _biased(found: Instrumental) -> list[Finding]:
    """Say what the test means; nothing of a loop that explains less than the model does, or of a bias too small."""
    shift, min_shift = found.shift, 1.0  # standard deviations of a shift that is worth a word (our choice)
    if not found.verdict.biased() or not found.valid or not found.explains or shift.max() < min_shift:
        return []
    names = [f"{found.names[k]} by {shift[k]:.2g} σ" for k in np.argsort(-shift)[:5]]
    return [finding("least-squares-biased", p=found.verdict.p, names=names)]


def _blurred(test: LoopTest) -> list[Finding]:
    """Say where W is no longer its true value plus noise, which instruments take for granted."""
    if test.found is None or test.loops is None or not test.found.estimator.measured:
        return []
    noise, max_blur = test.loops.pairs[0][0].motion.velocity_noise(), 3.0  # widths of the sign (our choice)
    widths = {one.acts[0][0]: one.settings[-1] for one in test.found.plant.terms if one.shape == "sign"}
    blurred = [(j, noise[j] / width) for j, width in widths.items() if noise[j] > max_blur * width]
    joints = [f"{size:.2g} at joint {j + 1}" for j, size in blurred]
    return [finding("noisy-signs", joints=joints)] if joints else []


SIGMAS = 5.0  # of both together, by which a parameter differs surely (our choice)


@dataclass(frozen=True)
class LoopDisagreement:
    """Comparison of an estimate that relies on the stated loop with one that does not.

    Attributes:
        method, beside: of the two.
        parameter, sigmas: the one that differs most, and by how many standard deviations of both together.
        left, beside_left: by torque row, share of the torque in the band that each leaves unexplained [%].
        factor: by torque row, the method's torque over the other's.
    """

    method: str
    beside: str
    parameter: str
    sigmas: float
    left: tuple[float, ...]
    beside_left: tuple[float, ...]
    factor: tuple[float, ...]


def disagreement(problem: IdentificationProblem, found: MethodEstimate, test: LoopTest) -> LoopDisagreement | None:
    """Return where an output-error estimate is refuted by recorded torques; None where it is not, or is another's.

    Args:
        problem: of both.
        found: the estimate.
        test: what instruments say; without any, least squares takes their place.
    """
    if not (found.found and found.alone and found.loops is not None):
        return None
    own, instruments = found.estimate, test.found
    max_beside_instruments = 1.2  # times the torque that instruments leave unexplained (our choice)
    max_beside_wls = 2.0  # the same beside least squares, of which it is the least that there is (our choice)
    if instruments is not None and instruments.valid and len(instruments.names) == len(own.values):
        name, other, limit = instruments.estimator.name, instruments.fit.estimate, max_beside_instruments
        left, beside = (instruments.simulated_error(x.values) for x in (own, other))
    else:
        plain = WLS.estimate(problem)
        if not plain.found:
            return None
        name, other, limit = "wls", plain.estimate, max_beside_wls
        left, beside = (problem.pooled.relative_errors(x.values) for x in (own, other))
    away = np.abs(own.values - other.values) / np.maximum(np.hypot(own.sigma, other.sigma), 1e-300)
    worst = int(np.argmax(away))
    if away[worst] < SIGMAS or not np.any(left > limit * beside):
        return None
    return LoopDisagreement(
        found.method, name, other.names[worst], float(away[worst]), tuple(left.tolist()), tuple(beside.tolist()),
        _factors(problem, own.values, other.values),
    )  # fmt: skip


def _factors(problem: IdentificationProblem, own: np.ndarray, other: np.ndarray) -> tuple[float, ...]:
    """Return, for each torque row, the regression slope of the torques W own on W other."""
    factors = problem.pooled.factors[:, :, :-1]
    mine, theirs = factors @ own, factors @ other
    return tuple(map(float, np.sum(mine * theirs, axis=1) / np.maximum(np.sum(theirs**2, axis=1), 1e-300)))
