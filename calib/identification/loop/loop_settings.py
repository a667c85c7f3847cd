"""Settings of the closed loop in which recordings were made: table [loop] of the options file.

Instrumental variables (method iv) simulate that loop; with another method and a [loop], the same simulation tests
whether least squares is biased. Gains are what the joints feel, torque per position error on the joint side::

    [loop]
    controller = "pd"                # pd, cascade, or identify: gains read from the logs (ARX, see below)
    kp = [12000.0, 4500.0]           # pd: [N m/rad], one per joint or one for all; kd [N m s/rad], ki [N m/(rad s)]
    kd = [90.0, 28.0]
    position = [40.0, 40.0]          # cascade P-PI: P [1/s], velocity K [N m s/rad], reset Ti [s] (none: P-P)
    velocity = [90.0, 28.0]
    reset = 0.05
    share = 1.0                      # of the reference's velocity that the velocity loop sees
    rate = 5000.0                    # of the controller [Hz], whole multiple of the log's or not; default: the log's,
                                     # or the least multiple of it that is 1 kHz or more
    delay = 1                        # control periods from measurement to torque
    limit = [130.0, 60.0]            # saturation [N m]
    windup = 0.1                     # largest integral of the error [rad s]
    velocity_cutoff = 200.0          # low-pass of the measured velocity [Hz]
    reference_velocity = "derivative"  # of q_ref at the instant; or "difference": over the period before it
    feedforward = "none"             # none; cad: the robot's own inertias; recording: column tau_ff
    reference = "recording"          # the column q_ref (q_des, q_cmd, …); or a file, see below
    design = [1.2, 1.5]              # inertias for which the gains are stated [kg m²], if they follow the estimate
    inertia = [0.4, 0.5]             # of the robot the simulation starts from [kg m²]; default kd² / (2 kp)
    instruments = "iv"               # iv, or didim: the simulated motion alone
    positive = ["Ia1", "Fv1"]        # base parameters that must not be negative
    band = 20.0                      # identify: up to which frequency [Hz] the gains are read
    integral = false                 # identify: look for ki too

In the simulated controller the measured velocity is a backward difference, (q_k - q_k-1) · rate, and so half a period
late, then low-passed at velocity_cutoff; the reference's is q_ref's derivative at instant k (of a cubic spline through
the logged samples), on time. A controller that takes the backward difference of q_ref as well needs
``reference_velocity = "difference"``: else methods that rest on the loop (cloe, clie) find kd / (2 rate) too much
inertia. The position error is q_ref,k - q_k, the torque is held over the period after `delay` more of them.

A reference of its own is a table (CSV) or an archive (npz) with stamps and q_ref or q, no torques; its clock is the
recording's: both count from their first sample. ``[files."run.csv"] reference = "run_ref.csv"`` states one per
recording, relative to the options file.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Annotated, Any

import numpy as np

from calib.config import strict
from calib.config_types import Flag, Name, Names, OneOf, Positive, Real, Spread, Whole
from calib.errors import UsageError
from calib.simulation.loop.controllers import Controller, cascade, pd

CONTROLLERS = ("pd", "cascade", "identify")
SPEEDS = ("derivative", "difference")
AHEAD = ("none", "cad", "recording")
INSTRUMENTS = ("iv", "didim")
NEEDED = {"pd": ("kp", "kd"), "cascade": ("position", "velocity"), "identify": ()}
OWNED = {"pd": ("kp", "kd", "ki"), "cascade": ("position", "velocity", "reset"), "identify": ("band", "integral")}


GAIN = "a number above 0, or a list with one per joint"
OTHER = "a number not below 0, or a list with one per joint"
Gains = Annotated[tuple[Annotated[float, Real(above=0, words=GAIN)], ...], Spread(words=GAIN)]
Gains0 = Annotated[tuple[Annotated[float, Real(least=0, words=OTHER)], ...], Spread(words=OTHER)]
Bounds = Annotated[tuple[Annotated[float, Real(above=0, infinite=True, words=GAIN)], ...], Spread(words=GAIN)]


@strict
@dataclass(frozen=True)
class LoopSettings:
    """Settings of the loop; the module documents each key. Tuples contain one value, or one per joint."""

    controller: Annotated[str, OneOf(CONTROLLERS)]
    kp: Gains = ()
    kd: Gains0 = ()
    ki: Gains0 = (0.0,)
    position: Gains = ()
    velocity: Gains = ()
    reset: Bounds = (np.inf,)
    share: Annotated[float, Real(above=0, most=1.0)] = 1.0
    rate: Annotated[float, Real(above=0, most=1e5, unit="Hz")] | None = None
    delay: Annotated[int, Whole(0, 100, " of control periods,")] = 0
    limit: Bounds = (np.inf,)
    windup: Bounds = (np.inf,)
    velocity_cutoff: Positive | None = None
    reference_velocity: Annotated[str, OneOf(SPEEDS)] = "derivative"
    feedforward: Annotated[str, OneOf(AHEAD)] = "none"
    reference: Name = "recording"
    design: Gains = ()
    inertia: Gains = ()
    instruments: Annotated[str, OneOf(INSTRUMENTS)] = "iv"
    positive: Names = ()
    band: Positive = 20.0
    integral: Flag = False

    def check_lengths(self, n: int) -> None:
        """Raise an error for a list whose length is neither 1 nor n.

        Raises:
            UsageError: with the key.
        """
        for key in (one.name for one in fields(self) if isinstance(getattr(self, one.name), tuple)):
            if key != "positive" and getattr(self, key):
                self.per_joint(key, n)

    def completed(self, controller: Controller, n: int) -> Controller:
        """Return the controller with saturation, delay and filter of the settings added to its gains."""
        return Controller(
            controller.kp, controller.kd, controller.ki, np.full(n, self.share), self.per_joint("limit", n),
            self.per_joint("windup", n), delay=self.delay, cutoff=self.velocity_cutoff,
        )  # fmt: skip

    def per_joint(self, key: str, n: int) -> np.ndarray:
        """Return the values (n,) of a key that has one value or n."""
        found = getattr(self, key)
        if len(found) not in (1, n):
            raise UsageError(f"[loop] {key}: {len(found)} values for {n} joints; give one, or one per joint")
        return np.broadcast_to(np.array(found, dtype=float), (n,)).copy()

    def stated_controller(self, n: int) -> Controller:
        """Return the controller with the stated gains, for n joints.

        Raises:
            UsageError: where the length of a list is not the number of joints.
        """
        if self.controller == "cascade":
            first, second, third = (self.per_joint(key, n) for key in ("position", "velocity", "reset"))
            made = cascade(first, second, third, share=self.share)
        else:
            made = pd(self.per_joint("kp", n), self.per_joint("kd", n), ki=self.per_joint("ki", n))
        return self.completed(made, n)


def check_loop(table: Any) -> Any:
    """Return the parsed table [loop] unchanged after a check that its gains fit its controller.

    Raises:
        ValueError: for a missing controller, gains of another controller, or missing gains.
    """
    kind = table.get("controller") if isinstance(table, Mapping) else ""
    if kind is None:
        raise ValueError(f"'controller' is missing; expected one of {', '.join(CONTROLLERS)}")
    if not isinstance(kind, str) or kind not in OWNED:
        return table
    for other, keys in OWNED.items():
        wrong = [key for key in keys if key in table and key not in OWNED[kind]]
        if wrong:
            raise ValueError(f"'{wrong[0]}' belongs to controller '{other}', found controller '{kind}'")
    for key in NEEDED[kind]:
        if key not in table:
            raise ValueError(f"controller '{kind}' needs {' and '.join(NEEDED[kind])}; '{key}' is missing")
    if kind == "identify" and table.get("share", 1.0) != 1.0:
        raise ValueError("share: not supported with controller = 'identify', which assumes share = 1")
    return table
