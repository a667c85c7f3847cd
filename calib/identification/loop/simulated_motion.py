"""The simulated motion of a loop in place of the recorded one: the same instants, the same low-pass."""

from dataclasses import replace

import numpy as np

from calib.data.signals.filtering import curvature, low_pass, slope
from calib.data.signals.motion import Motion
from calib.errors import CalibError
from calib.identification.loop.loop_recordings import Loop
from calib.identification.rows import Case
from calib.simulation.loop.closed_loop import SimulatedRun


def simulated_case(case: Case, run: SimulatedRun, loop: Loop) -> Case:
    """Return the case with the simulated motion at the instants of the recorded one, filtered like that one.

    The same low-pass and differences: what they do to a motion (they round off reversals) is in W and in Z alike, and
    what tells W from Z is noise.
    """
    index, motion = simulated_samples(case, run.t, loop), case.motion
    q, less = (low_passed(run.q, motion, at) for at in (motion.cutoff, motion.velocity_cutoff))
    v, a = slope(less, motion.rate), curvature(q, motion.rate)
    return replace(case, motion=replace(motion, q=q[index], v=v[index], a=a[index]))


def simulated_samples(case: Case, t: np.ndarray, loop: Loop) -> np.ndarray:
    """Return the places of a case's instants among the simulated ones `t` [s]."""
    step = loop.reference.period * loop.every
    since = case.motion.t - loop.reference.t[0]
    index = np.rint(since / step).astype(int)
    if index[0] < 0 or index[-1] >= len(t) or np.abs(index * step - since).max() > 0.01 * step:
        raise CalibError(
            f"the recording runs from {case.motion.t[0]:.6g} s to {case.motion.t[-1]:.6g} s in steps of "
            f"{1 / case.motion.rate:.6g} s, the simulation from {t[0]:.6g} s to {t[-1]:.6g} s in steps of "
            f"{step:.6g} s: give the whole reference, and `every`"
        )
    return index


def low_passed(q: np.ndarray, motion: Motion, cutoff: np.ndarray | None = None) -> np.ndarray:
    """Return simulated positions (N, n), or their slopes (N, n, ...), through the low-pass of the recorded ones.

    Args:
        cutoff: (n,) of another of its filters [Hz].
    """
    result, cutoffs = np.empty_like(q), motion.cutoff if cutoff is None else cutoff
    for f in np.unique(cutoffs):
        own = cutoffs == f
        result[:, own] = low_pass(q[:, own], motion.rate, float(f))
    return result
