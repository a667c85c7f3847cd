"""Is least squares biased? The loop a recording came from, simulated, says so, and offers the estimate that is not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.data.signals.decimation import Decimator
from calib.data.signals.motion import velocity_noise
from calib.dynamics.base import Base
from calib.dynamics.idim import IdentificationModel
from calib.errors import CalibError, UsageError
from calib.identification.cases import Case
from calib.identification.loop.loop_recordings import ClosedLoops, close_loops
from calib.identification.loop.loop_settings import per_joint
from calib.identification.methods.instrumental import Instrumental, identify_instrumental
from calib.identification.settings import IdentificationSettings
from calib.robot.chain import Chain

FOLLOWS = 10.0  # [%] of a joint's motion by which the simulated robot may miss the recorded one (our choice)
BLUR = 3.0  # widths of the smoothed sign that the noise of the velocity may have (our choice)
SMALL = 3.0  # standard deviations of a shift that does not matter, however surely it is there (our choice)


@dataclass(frozen=True, eq=False)
class LoopTest:
    """What instruments from simulation came to.

    Attributes:
        found: their estimate of the standard model, with the test of least squares; None where there is none.
        loops: what was simulated.
        failure: why there is no estimate.
        method: of the instruments, ``iv`` or ``didim``.
    """

    found: Instrumental | None = None
    loops: ClosedLoops | None = None
    failure: str = ""
    method: str = "iv"

    def lines(self, method: str) -> list[str]:
        """Return what a user should be warned of who took the estimate of `method`."""
        if self.failure:
            return [f"the test of least squares by simulation of the closed loop failed: {self.failure}"]
        if self.found is None:
            return []
        told = [*_weakness(self.found), *_distance(self.found)]
        return told + (_blurred(self) if method == "iv" else _words(self.found))


def require_loop(settings: IdentificationSettings) -> IdentificationSettings:
    """Return the settings of method ``iv``, whose model is one that can be simulated.

    Raises:
        UsageError: where no loop is stated, or the model cannot be simulated.
    """
    if settings.loop is None:
        raise UsageError(
            "method 'iv' simulates the closed loop: state its controller in the options file, [loop] controller = … "
            "(calib formats identify-options), and log or state the reference; from q and torque alone use wls or irls"
        )
    if not settings.torque_rows.motors_alone:
        raise UsageError(
            f"method 'iv' explains motor torques; rows = '{settings.torque_rows.name}' needs ols, wls, irls or tls"
        )
    if settings.friction not in ("auto", "standard"):
        raise UsageError(
            f"method 'iv' simulates standard friction only, not friction = '{settings.friction}'; use wls, whose "
            "estimate a [loop] then tests for bias"
        )
    return replace(settings, friction="standard")


def try_loop(
    chain: Chain, model: IdentificationModel, base: Base, cases: Sequence[Case], decimator: Decimator,
    settings: IdentificationSettings,
) -> LoopTest:  # fmt: skip
    """Return the IV estimate of the standard model; nothing without a loop.

    Where it stands beside another method's estimate its failure is told; where it is the method, raised.
    """
    loop, loops = settings.loop, None
    if loop is None:
        return LoopTest()
    try:
        if not settings.torque_rows.motors_alone:
            raise UsageError("instruments from simulation are for motor torques alone")
        loops = close_loops(chain, model.bodies, cases, decimator, loop)
        start = per_joint(loop, "inertia", chain.n) if loop.inertia else None
        found = identify_instrumental(
            model, base, loops.pairs, decimator, method=loop.instruments, inertia=start, positive=loop.positive
        )  # fmt: skip
    except CalibError as error:
        if settings.method == "iv":
            raise
        return LoopTest(None, loops, str(error))
    return LoopTest(found, loops, method=loop.instruments)


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


def _distance(found: Instrumental) -> list[str]:
    far = [f"{x:.3g} % at joint {j + 1}" for j, x in enumerate(found.distance) if not x < FOLLOWS]
    if not far:
        return []
    return [
        f"the simulated robot does not follow the recorded one ({', '.join(far)} of its motion apart): wrong gains, "
        "control rate, delay or reference? Estimates bear a third of the right bandwidth, not another loop"
    ]


def _words(found: Instrumental) -> list[str]:
    """Say what the test means."""
    if not found.verdict.biased() or not found.valid:
        return []
    shift = found.shift
    worst = np.argsort(-shift)[:5]
    named = ", ".join(f"{found.names[k]} by {shift[k]:.2g} sigma" for k in worst)
    p = f"p = {found.verdict.p:.2g}" if found.verdict.p > 0.0 else "p < 1e-300"
    if shift.max() < SMALL:
        return [f"least squares is biased ({p}), but by little: {named}"]
    return [f"least squares is biased (Durbin, Wu, Hausman: {p}), off {named}: --method iv is not"]


def _blurred(test: LoopTest) -> list[str]:
    """Say where W is no longer its true value plus noise, which instruments take for granted."""
    if test.found is None or test.loops is None:
        return []
    case = test.loops.pairs[0][0]
    noise = velocity_noise(case.motion)
    widths = {one.acts[0][0]: one.settings[-1] for one in test.found.plant.terms if one.shape == "sign"}
    wide = [f"{noise[j] / width:.2g} at joint {j + 1}" for j, width in widths.items() if noise[j] > BLUR * width]
    if not wide or test.method == "didim":
        return []
    return [
        f"the noise of the velocities is wider than the Coulomb sign ({', '.join(wide)} widths v0): the sign's columns "
        "shrink, and IV makes up by too much Fc and too little Fv; instruments = 'didim' looks at no measured position"
    ]
