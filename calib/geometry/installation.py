"""An arm as it stands in the cell: chain, instrument placements, tool placements and joint deflections."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from calib.arrays import frozen
from calib.data.poses.measurements import PoseMeasurements
from calib.robot.calibrated import Deflection, extra_displacements
from calib.robot.chain import Chain
from calib.robot.kinematics import Sweep, sweep

FRAME_AXES = ("x", "y", "z", "rx", "ry", "rz")


class NoOptics:
    """The parameters that instruments add to an installation, where none does; see a camera's for one that does."""

    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    values = frozen(np.zeros(0))
    moving = frozen(np.zeros(0), int)

    def __len__(self) -> int:
        return 0

    def like(self, other: Any) -> NoOptics:
        """Return the same instruments with the values of another's."""
        return self

    def view(self, measured: PoseMeasurements, free: np.ndarray) -> Any:
        """Return what predicts a block's rows beside the poses; `free` counts from the first of these parameters."""
        return None

    def tables(self) -> Mapping[str, Any]:
        """Return the tables of ``robot.toml`` that hold the parameters."""
        return {}


@dataclass(frozen=True, eq=False)
class Installation:
    """T_i = station_{s(i)} · arm(q_i + deflection) · tool_{t(i)}.

    Attributes:
        chain: the arm, base to tip.
        stations: (S, 4, 4) poses of the arm's base in each instrument's frame.
        tools: (T, 4, 4) poses of each target in the tip's frame.
        station_names, tool_names: S and T strings.
        deflection: what q does not say (stiffness, coupling, harmonics), to be fitted.
        known: deflections found earlier, which stay as they are.
        optics: cameras and boards, where images were taken: parameters with what `NoOptics` has.
    """

    chain: Chain
    stations: np.ndarray = field(default_factory=lambda: np.eye(4)[None])
    tools: np.ndarray = field(default_factory=lambda: np.eye(4)[None])
    station_names: tuple[str, ...] = ("station",)
    tool_names: tuple[str, ...] = ("tool",)
    deflection: Deflection = field(default_factory=Deflection)
    known: Deflection = field(default_factory=Deflection)
    optics: Any = field(default_factory=NoOptics)

    def __post_init__(self) -> None:
        object.__setattr__(self, "stations", frozen(self.stations))
        object.__setattr__(self, "tools", frozen(self.tools))

    def merged(self) -> Installation:
        """Return the same installation with known and fitted deflections as one."""
        if not self.known.terms:
            return self
        terms = (*self.known.terms, *self.deflection.terms)
        values = np.concatenate([np.asarray(self.known.coefficients), np.asarray(self.deflection.coefficients)])
        reference = self.known.reference if self.deflection.reference is None else self.deflection.reference
        return replace(self, deflection=Deflection(terms, values, reference), known=Deflection())


@dataclass(frozen=True, eq=False)
class Seen:
    """The targets as the instrument sees them, for m rows.

    Attributes:
        walked: the pass along the chain, in the station's frame.
        point: (3, m) target positions [m].
        rotation: (3, 3, m) target rotations, ``rotation[c]`` being column c.
        view: of images, what of camera and board they are predicted with; None for other instruments.
    """

    walked: Sweep
    point: np.ndarray
    rotation: np.ndarray
    view: Any = None

    def poses(self) -> np.ndarray:
        """Return the target poses (m, 4, 4) in the station's frame."""
        return replace(self.walked, rotation=self.rotation, position=self.point).poses()


def see(
    cell: Installation,
    q: np.ndarray,
    station: int = 0,
    tool: np.ndarray | int = 0,
    bases: np.ndarray | None = None,
    given: np.ndarray | None = None,
) -> Seen:
    """Predict what an instrument sees at joint values q (m, n).

    Args:
        cell: the installation.
        q: (m, n) [rad or m].
        station: index of the instrument placement; -1 for the arm's base frame.
        tool: index of the target, one or (m,).
        bases: (E, m) of the deflection's terms at q; evaluated here where None.
        given: (K, m) displacements by the known deflections; evaluated here where None.
    """
    extra = extra_displacements(cell.chain, cell.deflection, q, bases)
    given = extra_displacements(cell.chain, cell.known, q) if given is None else given
    extra = given if extra is None else extra if given is None else extra + given
    walked = sweep(cell.chain, q, None if station < 0 else cell.stations[station], extra)
    if len(cell.tools) == 1 or np.ndim(tool) == 0:
        placement = cell.tools[0 if len(cell.tools) == 1 else int(np.asarray(tool))]
        flat = walked.rotation.reshape(3, -1)
        point = walked.position + (placement[:3, 3] @ flat).reshape(walked.position.shape)
        rotation = (placement[:3, :3].T @ flat).reshape(walked.rotation.shape)
    else:
        placement = cell.tools[np.asarray(tool)]
        point = walked.position + np.einsum("cdm,mc->dm", walked.rotation, placement[:, :3, 3])
        rotation = np.einsum("cdm,mce->edm", walked.rotation, placement[:, :3, :3])
    return Seen(walked, point, rotation)
