"""Does the prior of a fleet pay? Fits of few poses of one arm with the prior of the others, and errors at other poses.

python tests/benchmarks/fleet_prior.py --factory FOLDER [--draws 8]

FOLDER/ur5 holds factory calibrations of UR5 arms, as `ur_calibration` writes them (``my_robot_calibration.yaml``; many
stand in public repositories), FOLDER/ur10 of UR10 arms. An arm of those is measured by simulation (0.1 mm of noise);
the measured UR5, UR10 and Pandas are those of the recordings. Rms errors in mm, the median over draws of the poses.
"""

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

import calib
from calib.apps.fleet import arm_distribution
from calib.data.poses.fit_options import FitOptions
from calib.data.poses.measurements import PoseMeasurements, Positions, take
from calib.errors import CalibError
from calib.robot.calibrated import CalibratedChain
from calib.robot.chain import Chain
from calib.robot.kinematics import forward

DATA = Path(__file__).parents[3] / "shared/data"
LINKS = "shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3"
SIGMA = 1e-4  # [m] stated: what a rigid geometry leaves; estimated from few rows it is too large, and pulls too much
SIZES = 8, 10, 15, 20, 40
GEOMETRY = calib.FitSettings(model="geometry")


@dataclass(frozen=True)
class Arm:
    """An arm to be measured: its nominal description, all its poses, and who draws which to fit and which to test."""

    robot: CalibratedChain
    block: PoseMeasurements
    options: FitOptions
    draw: Callable[[np.random.Generator, int], tuple[np.ndarray, np.ndarray]]


def rms(arm: Arm, way: str, others: Sequence[CalibratedChain], few: np.ndarray, rest: np.ndarray) -> float:
    robot, options, settings = arm.robot, arm.options, GEOMETRY
    if way == "offsets":
        settings = calib.FitSettings(model="offsets")
    if way == "any prior":
        names, units = robot.chain.names, robot.chain.units
        options = replace(options, prior={n: 5e-4 if u == "m" else 5e-3 for n, u in zip(names, units)})
    if way == "fleet":
        found = arm_distribution.spread(others)
        robot = arm_distribution.expected_arm(others, found)
        options = replace(options, prior={one.name: one.width for one in found})
    try:
        result = calib.fit_geometry(
            robot, take(arm.block, few), settings, validate=take(arm.block, rest), options=options
        )  # fmt: skip
    except CalibError:
        return np.nan
    position = next(iter(result.validation.values())).errors[1].position
    return 1e3 * float(np.sqrt(np.mean(position**2)))


def line(
    name: str,
    arms: Mapping[str, Arm],
    others: Mapping[str, Sequence[CalibratedChain]],
    draws: int,
    sizes: Sequence[int],
) -> None:
    """Print, by number of poses, the errors of each way over arms and draws."""
    print(name)
    for size in sizes:
        found = {way: list[float]() for way in ("offsets", "no prior", "any prior", "fleet")}
        for key, arm in arms.items():
            for seed in range(draws):
                few, rest = arm.draw(np.random.default_rng(seed), size)
                for way, own in found.items():
                    own.append(rms(arm, way, others[key], few, rest))
        values = {way: np.array(own) for way, own in found.items()}
        shown = [f"{way} {np.median(own):.3f}" if np.isfinite(own).all() else f"{way} –" for way, own in values.items()]
        better = int((values["fleet"] < values["no prior"]).sum())
        print(f"{size:4d} poses: {', '.join(shown)}; fleet better in {better} of {len(own)}", flush=True)


def anywhere(count: int) -> Callable:
    def draw(random: np.random.Generator, size: int) -> tuple[np.ndarray, np.ndarray]:
        order = random.permutation(count)
        return np.sort(order[:size]), np.sort(order[size : size + 300])

    return draw


def one_place(block: PoseMeasurements) -> Callable:
    """Return a draw of rows from the two sockets of one place; tested at all others."""

    def draw(random: np.random.Generator, size: int) -> tuple[np.ndarray, np.ndarray]:
        first = 2 * random.integers(len(block.group_names) // 2)
        own = np.isin(block.group, (first, first + 1))
        return np.sort(random.permutation(np.flatnonzero(own))[:size]), np.flatnonzero(~own)

    return draw


def placed(origin: Mapping[str, float]) -> np.ndarray:
    result = np.eye(4)
    result[:3, :3] = Rotation.from_euler("xyz", [origin[key] for key in ("roll", "pitch", "yaw")]).as_matrix()
    result[:3, 3] = [origin[key] for key in "xyz"]
    return result


def factory(path: Path, nominal: Chain) -> Chain:
    """Return the arm of a factory calibration."""
    values = []
    found = yaml.safe_load(path.read_text())["kinematics"]
    for joint, origin in enumerate(found[link] for link in LINKS):
        place = nominal.elements[6 * joint].placement
        step = np.linalg.solve(np.eye(4) if place is None else place, placed(origin))
        values += [*step[:3, 3], *Rotation.from_matrix(step[:3, :3]).as_euler("XYZ")]
    return nominal.with_values(np.array(values))


def simulated(arm: Chain, count: int, seed: int, tool: Sequence[float]) -> Positions:
    random = np.random.default_rng(seed)
    q = random.uniform(-np.pi, np.pi, (count, arm.n))
    seen = (forward(arm, q) @ [*tool, 1.0])[:, :3] + 1e-4 * random.standard_normal((count, 3))
    return Positions(q, arm.joint_names, seen, file="simulated.csv", sigma=np.full((count, 3), SIGMA))


def universal(folder: Path, robot: CalibratedChain) -> tuple[dict[str, Arm], dict[str, CalibratedChain]]:
    """Return arms of factory calibrations, measured by simulation, and what a fit of 60 poses gives of each."""
    arms, fits = {}, {}
    for number, path in enumerate(sorted(folder.glob("*.yaml"))):
        chain, none = factory(path, robot.chain), FitOptions()
        arms[path.stem] = Arm(robot, simulated(chain, 340, number, (0.0, 0.0, 0.05)), none, anywhere(340))
        few = simulated(chain, 60, 1000 + number, (0.0, 0.0, 0.05))
        fits[path.stem] = calib.fit_geometry(robot, few, GEOMETRY).robot
    return arms, fits


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--factory", type=Path, required=True)
    parser.add_argument("--draws", type=int, default=8)
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES)
    given = parser.parse_args()
    none = FitOptions()
    robot = calib.load(DATA / "ur5_gts3800/model.urdf")
    arms, fits = universal(given.factory / "ur5", robot)
    rest = {name: [one for other, one in fits.items() if other != name] for name in arms}
    line(f"each of {len(arms)} UR5 (real geometry, simulated measurements), by the others", arms, rest, 1, given.sizes)
    measured = calib.read_poses(DATA / "ur5_gts3800/grid_800.csv", robot)[0]
    measured = replace(measured, sigma=np.full((len(measured), 3), SIGMA))
    target = np.genfromtxt(DATA / "ur5_gts3800/grid_800.csv", delimiter=",", skip_header=1)[:, 6:9]
    for sign, block in (
        ("as stated", measured),
        ("reversed", replace(measured, position=2 * target - measured.measured)),
    ):
        one = {"ur5": Arm(robot, block, none, anywhere(800))}
        line(
            f"the measured UR5, its differences {sign}, by {len(fits)} others",
            one,
            {"ur5": [*fits.values()]},
            given.draws,
            given.sizes,
        )
    robot = calib.load(DATA / "ur10_ipa/model.urdf")
    _, fits = universal(given.factory / "ur10", robot)
    block = calib.read_poses(DATA / "ur10_ipa/B_joint_configurations.csv", robot)[0]
    one = {"ur10": Arm(robot, block, none, anywhere(len(block)))}
    line(f"the measured UR10, by {len(fits)} other", one, {"ur10": [*fits.values()]}, given.draws, given.sizes)
    sockets, robot = FitOptions(socket_distance=0.05), calib.load(DATA / "mukca_sockets/panda.urdf")
    blocks = {k: calib.read_poses(DATA / f"mukca_sockets/panda_{k}.csv", robot, options=sockets)[0] for k in (2, 3)}
    fits = {k: calib.fit_geometry(robot, block, GEOMETRY, options=sockets).robot for k, block in blocks.items()}
    for k, other in ((2, 3), (3, 2)):
        one = {"panda": Arm(robot, blocks[k], sockets, one_place(blocks[k]))}
        line(
            f"Panda {k} (sockets of one place), by Panda {other}",
            one,
            {"panda": [fits[other]]},
            given.draws,
            given.sizes,
        )


if __name__ == "__main__":
    main()
