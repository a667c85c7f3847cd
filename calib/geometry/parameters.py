"""Vector of all fit parameters of the geometry: names, layout and steps along it.

Order: arm elements (K), six per station (x y z rx ry rz, in the station-to-base placement's own axes), six per tool (in
the target's own axes), of images the lenses' values and the boards' shapes, deflection coefficients (E).
"""

from dataclasses import dataclass, replace

import numpy as np

from calib.data.poses.fit_options import FitOptions
from calib.errors import UsageError, require
from calib.geometry.installation import FRAME_AXES, Installation
from calib.robot import calibrated
from calib.transforms import displace


@dataclass(frozen=True)
class ParameterLayout:
    """Layout of the full parameter vector by kind of parameter.

    Attributes:
        names, units: one per parameter.
        arm, stations, tools, optics, terms: how many of each.
        moving: positions of the optics that may be fitted.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    arm: int
    stations: int
    tools: int
    optics: int
    terms: int
    moving: tuple[int, ...] = ()

    def group(self, index: int) -> str:
        """Return the kind of the parameter at an index: 'arm', 'station', 'tool', 'optics' or 'deflection'."""
        edges = np.cumsum([self.arm, self.stations, self.tools, self.optics])
        return ("arm", "station", "tool", "optics", "deflection")[int(np.searchsorted(edges, index, side="right"))]

    @property
    def arm_index(self) -> np.ndarray:
        return np.arange(self.arm)

    @property
    def frame_index(self) -> np.ndarray:
        """Indices of placements and of fitted camera and board parameters: all but the robot's."""
        placed = np.arange(self.arm, self.arm + self.stations + self.tools)
        return np.concatenate([placed, np.array(self.moving, dtype=int)])

    @property
    def station_index(self) -> np.ndarray:
        return np.arange(self.arm, self.arm + self.stations)

    @property
    def tool_index(self) -> np.ndarray:
        return np.arange(self.arm + self.stations, self.arm + self.stations + self.tools)

    @property
    def term_index(self) -> np.ndarray:
        return np.arange(len(self.names) - self.terms, len(self.names))

    def find(self, names: list[str] | tuple[str, ...]) -> np.ndarray:
        """Return the indices of named parameters.

        Raises:
            UsageError: for a name that does not exist.
        """
        table = {name: k for k, name in enumerate(self.names)}
        for name in names:
            require(name in table, f"unknown parameter '{name}'; expected one of {', '.join(self.names)}", UsageError)
        return np.array([table[name] for name in names], dtype=int)


def layout(cell: Installation) -> ParameterLayout:
    """Return the layout of an installation's parameters."""
    units = ("m", "m", "m", "rad", "rad", "rad")
    frames = [f"{name}.{axis}" for name in (*cell.station_names, *cell.tool_names) for axis in FRAME_AXES]
    terms = cell.deflection.terms
    element_units = dict(zip(cell.chain.names, cell.chain.units))
    return ParameterLayout(
        names=(*cell.chain.names, *frames, *cell.optics.names, *cell.deflection.names(cell.chain)),
        units=(
            *cell.chain.units, *(units * (len(frames) // 6)), *cell.optics.units,
            *(_unit(element_units, term) for term in terms),
        ),
        arm=len(cell.chain.elements),
        stations=6 * len(cell.stations),
        tools=6 * len(cell.tools),
        optics=len(cell.optics),
        terms=len(terms),
        moving=tuple((len(cell.chain.elements) + len(frames) + cell.optics.moving).tolist()),
    )  # fmt: skip


def _unit(units: dict[str, str], term: calibrated.Term) -> str:
    return units[term.element] + {"torque": "/(N m)", "joint": "/rad"}.get(term.basis, "")


def step(cell: Installation, free: np.ndarray, change: np.ndarray) -> Installation:
    """Return the installation changed by `change` (f,) in the parameters `free` (f,); frames move on the manifold."""
    where = layout_counts(cell)
    full = np.zeros(sum(where))
    full[free] = change
    arm, stations, tools, optics, terms = np.split(full, np.cumsum(where)[:-1])
    stations, tools = stations.reshape(-1, 6), tools.reshape(-1, 6)
    return replace(
        cell,
        chain=cell.chain.with_values(cell.chain.values + arm) if arm.any() else cell.chain,
        stations=np.array([displace(s, d) if d.any() else s for s, d in zip(cell.stations, stations)]),
        tools=np.array([displace(t, d) if d.any() else t for t, d in zip(cell.tools, tools)]),
        deflection=cell.deflection.with_coefficients(np.asarray(cell.deflection.coefficients) + terms)
        if len(terms)
        else cell.deflection,
        optics=cell.optics.with_values(cell.optics.values + optics) if optics.any() else cell.optics,
    )


def layout_counts(cell: Installation) -> tuple[int, int, int, int, int]:
    """Return the numbers of parameters of arm, stations, tools, optics and deflection."""
    frames = 6 * len(cell.stations), 6 * len(cell.tools)
    return len(cell.chain.elements), *frames, len(cell.optics), len(cell.deflection.terms)


def parameter_values(cell: Installation) -> np.ndarray:
    """Return the full parameter vector; frames have zeros: displacements from their present placement."""
    _, stations, tools, _, _ = layout_counts(cell)
    terms = np.asarray(cell.deflection.coefficients)
    return np.concatenate([cell.chain.values, np.zeros(stations + tools), cell.optics.values, terms])


def fixed_parameters(start: Installation, options: FitOptions) -> np.ndarray:
    """Return the indices of parameters fixed at their nominal values: those in ``fix``, or all but those in ``free``.

    ``free`` speaks of the arm; frames are always fitted.
    """
    table = layout(start)
    fixed = table.find(options.fix)
    if options.free:
        fixed = np.union1d(fixed, np.setdiff1d(table.arm_index, table.find(options.free)))
    return fixed


def stated_prior(start: Installation, options: FitOptions) -> np.ndarray | None:
    """Return the prior standard deviations stated in the options, for the full vector; infinite where not stated."""
    if not options.prior:
        return None
    table = layout(start)
    prior = np.full(len(table.names), np.inf)
    prior[table.find(tuple(options.prior))] = list(options.prior.values())
    return prior
