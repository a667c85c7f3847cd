"""Is least squares biased? The loop a recording came from, simulated, says so, and offers the estimate that is not."""

from dataclasses import dataclass, replace

import numpy as np

from calib.errors import CalibError, UsageError
from calib.identification.loop.loop_recordings import ClosedLoops
from calib.identification.methods.instrumental import Instrumental
from calib.identification.methods.method import IdentificationProblem, MethodEstimate
from calib.identification.methods.simulated import IV
from calib.identification.settings import IdentificationSettings

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

    def lines(self, taken: bool) -> list[str]:
        """Return what a user should be warned of who took this estimate, or (`taken` False) one of least squares."""
        if self.failure:
            return [f"the test of least squares by simulation of the closed loop failed: {self.failure}"]
        if self.found is None:
            return []
        told = [*_weakness(self.found), *(_distance(self.found) or _gains(self.found))]
        return told + (_blurred(self) if taken else _words(self.found))


def require_loop(settings: IdentificationSettings) -> IdentificationSettings:
    """Return the settings of a method that simulates, whose model is one that can be.

    Raises:
        UsageError: where no loop is stated, or the model cannot be simulated.
    """
    name = settings.method
    if settings.loop is None:
        raise UsageError(
            f"method '{name}' simulates the closed loop: state its controller in the options file, [loop] controller = "
            "… (calib formats identify-options), and log or state the reference; from q and torque alone use wls or "
            "irls"
        )
    if not settings.torque_rows.motors_alone:
        raise UsageError(
            f"method '{name}' explains motor torques; rows = '{settings.torque_rows.name}' needs ols, wls, irls or tls"
        )
    if settings.friction not in ("auto", "standard"):
        raise UsageError(
            f"method '{name}' simulates standard friction only, not friction = '{settings.friction}'; use wls, whose "
            "estimate a [loop] then tests for bias"
        )
    return replace(settings, friction="standard")


def require_robot(settings: IdentificationSettings) -> IdentificationSettings:
    """Return the settings of a method that simulates the robot alone, whose model is one that can be.

    Raises:
        UsageError: for other torques than the motors', or richer friction.
    """
    name = settings.method
    if not settings.torque_rows.motors_alone:
        raise UsageError(f"method '{name}' explains motor torques; rows = '{settings.torque_rows.name}' needs wls")
    if settings.friction not in ("auto", "standard"):
        raise UsageError(f"method '{name}' simulates standard friction only, not friction = '{settings.friction}'")
    return replace(settings, friction="standard")


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


def _weakness(found: Instrumental) -> list[str]:
    strength = found.strength
    if not strength.weak:
        return []
    least = np.argsort(strength.partial_r2)[:5]
    named = ", ".join(f"{strength.names[k]} ({100 * strength.partial_r2[k]:.2g} %)" for k in least)
    return [
        f"weak instruments (Cragg-Donald {strength.cragg_donald:.3g}, wanted above 10): IV is biased towards least "
        f"squares and its sigmas are too small; of these columns the simulation explains least: {named}"
    ]


def _distance(found: Instrumental, max_miss: float = 10.0) -> list[str]:
    # max_miss: [%] of a joint's motion by which the simulated robot may miss the recorded one (our choice)
    far = [f"{x:.3g} % at joint {j + 1}" for j, x in enumerate(found.distance) if not x < max_miss]
    if not far:
        return []
    return [
        f"the simulated robot does not follow the recorded one ({', '.join(far)} of its motion apart): wrong gains, "
        "control rate, delay or reference? Estimates bear a third of the right bandwidth, not another loop"
    ]


def _gains(found: Instrumental) -> list[str]:
    """Say whose gains are not those of the recording: all that the simulated robot did was to follow."""
    if not len(found.off):
        return []
    named = ", ".join(f"{found.stray[j]:.2g} times at joint {j + 1}" for j in found.off)
    return [
        f"the recorded robot strays further from its reference than the simulated one, or less ({named}): are kp and "
        "kd of [loop] that many times the controller's? iv and didim bear it, cloe and clie do not"
    ]


def _words(found: Instrumental, max_shift: float = 1.0) -> list[str]:
    """Say what the test means; nothing of a loop that explains less than the model does, or of a bias too small.

    `max_shift`: standard deviations of a shift that is not worth a word (our choice).
    """
    if not found.verdict.biased() or not found.valid or not found.explains:
        return []
    shift = found.shift
    if shift.max() < max_shift:
        return []
    worst = np.argsort(-shift)[:5]
    named = ", ".join(f"{found.names[k]} by {shift[k]:.2g} sigma" for k in worst)
    p = f"p = {found.verdict.p:.2g}" if found.verdict.p > 0.0 else "p < 1e-300"
    if shift.max() < MAX_SHIFT_SIGMAS:
        return [f"least squares is biased ({p}), but by little: {named}"]
    return [f"least squares is biased (Durbin, Wu, Hausman: {p}), off {named}: method 'iv' is not"]


def _blurred(test: LoopTest, max_blur: float = 3.0) -> list[str]:
    """Say where W is no longer its true value plus noise, which instruments take for granted.

    `max_blur`: widths of the smoothed sign that the noise of the velocity may have (our choice).
    """
    if test.found is None or test.loops is None:
        return []
    case = test.loops.pairs[0][0]
    noise = case.motion.velocity_noise()
    widths = {one.acts[0][0]: one.settings[-1] for one in test.found.plant.terms if one.shape == "sign"}
    wide = [f"{noise[j] / width:.2g} at joint {j + 1}" for j, width in widths.items() if noise[j] > max_blur * width]
    if not wide or not test.found.estimator.measured:
        return []
    return [
        f"the noise of the velocities is wider than the Coulomb sign ({', '.join(wide)} widths v0): the sign's columns "
        "shrink, and IV makes up by too much Fc and too little Fv; instruments = 'didim' looks at no measured position"
    ]
