"""How well a 5-megapixel camera calibrates an LWR4+: rendered images, against a tracker and against two-step fitting.

The arm is the study's (Kolyubin et al. 2019, Table 2, calibrated column), rigid, so that what is left is the
instrument's. The camera in the hand takes rendered images of a ChArUco board at random postures that see it; lens,
mounting and placement are found from them. With 20, 40 and 80 of them:

    reprojection    all corners, geometry, camera and board in one least squares (what `calib fit` does)
    two steps       PnP poses of the board by the same lens, then a pose fit (the usual way)
    tracker         a reflector at the same postures, 20 µm per axis; and at postures all over the joint range

and the same with projected corners and the arm's hidden deflections. Errors are those of the tool over 2000 postures of
the whole joint range against the hidden truth.

    python examples/camera/accuracy.py --out camera-accuracy [--quick] [--speed] [--seeds 50] [--seed 0]

Some four minutes of processor time, most of it for rendering; images that are there already are taken again. --quick
renders small images, in ten seconds; --speed fits 200, 1000 and 5000 images instead, for time and memory; --seeds
repeats 40 images with projected corners, other postures and other noise each time: how often the stated sigmas of arm
and lens hold, and how two-step fitting compares.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from calib import files
from calib.data.images.image_folders import find_corners, read_images
from calib.data.images.lens import Lens
from calib.data.images.pixels import Pixels
from calib.data.poses import IN_HAND
from calib.data.poses.measurements import PoseMeasurements, take
from calib.geometry.camera.camera_guess import complete_camera, pnp_poses
from calib.geometry.first_guess import install
from calib.geometry.fit import GeometricFit, fit
from calib.geometry.observation import layout
from calib.robot.chain import random_joints
from calib.simulation.camera_cell import (
    FIVE_MEGAPIXEL,
    CameraCell,
    Views,
    camera_cell,
    photograph,
    take_pictures,
    views,
)
from calib.simulation.cell import Cell, SimulatedInstrument, measure
from calib.simulation.truth import position_errors
from calib.simulation.virtual_cells import rigid, virtual_cell
from calib.transforms import pose

COUNTS = (20, 40, 80)
SMALL = Lens("pinhole", np.array([780.0, 782.0, 400.0, 298.0, -0.12, 0.05, 4e-4, -3e-4, 0.0]), (800, 600))
ENCODER = 1e-5  # noise of the joint values [rad]
NOISE = 0.05  # of projected corners [px]


def fitted(chain: Any, block: PoseMeasurements) -> GeometricFit:
    """Return the fit of the full geometry to one block of images."""
    start = install(chain, [block])
    table = layout(start)
    return fit(start, [block], table.rigid_index)


def tracked(cell: Cell, q: np.ndarray, seed: int) -> PoseMeasurements:
    """Return the positions of a reflector next to the camera, measured by a tracker."""
    tracker = SimulatedInstrument("laser tracker", 20e-6, None, encoder_sigma=ENCODER)
    truth = replace(
        cell.truth, stations=pose(None, [2.5, 1.0, 0.5])[None], tools=pose(None, [0.05, 0.0, 0.08])[None]
    )  # fmt: skip
    return measure(replace(cell, truth=truth, instrument=tracker), q, seed)


def accuracy(found: CameraCell, images: Pixels, counts: tuple[int, ...], seed: int) -> dict[str, Any]:
    """Return the tool errors [mm] by number of images and kind of fit, with the σ stated by the fit."""
    cell, arm = found.cell, found.cell.nominal

    def error(result: GeometricFit) -> float:
        return position_errors(cell, result.cell, result.cell.chain)[2]

    table: dict[str, Any] = {}
    for count in counts:
        rows = np.arange(count)
        block = complete_camera(arm, take(images, rows))
        assert isinstance(block, Pixels) and block.sigma is not None
        result = fitted(arm, block)
        noise = result.pieces[0].part.noise  # type: ignore[attr-defined]
        anywhere = random_joints(arm, count, seed + 1)
        table[str(count)] = {
            "reprojection_mm": error(result),
            "two_steps_mm": error(fitted(arm, pnp_poses(block))),
            "tracker_same_postures_mm": error(fitted(arm, tracked(cell, images.q[rows], seed))),
            "tracker_anywhere_mm": error(fitted(arm, tracked(cell, anywhere, seed))),
            "corner_px": float(noise.factor * np.nanmedian(block.sigma)),
            "per_image": {"displacement_mm": 1e3 * noise.displacement, "turn_mrad": 1e3 * noise.turn},
        }
    table["nominal_mm"] = position_errors(cell, result.cell, result.cell.chain)[0]
    return table


def rendered(found: CameraCell, folder: Path, count: int, seed: int, sought: Views) -> tuple[Pixels, float]:
    """Return the corners found in rendered images, and the number of images per processor second."""
    if not (folder / "joints.csv").exists():
        take_pictures(found, views(found, count, seed, sought), folder, seed=seed)
    (folder / "corners.csv").unlink(missing_ok=True)
    started, names = time.process_time(), [path.name for path in sorted(folder.glob("*.png"))]
    find_corners(folder, found.board, names)
    rate = len(names) / (time.process_time() - started)
    return read_images(folder, found.cell.nominal.joint_names), rate


def speed(found: CameraCell, counts: tuple[int, ...], seed: int) -> dict[str, Any]:
    """Return processor seconds and memory of fits to many images with all corners in view."""
    result: dict[str, Any] = {}
    for count in counts:
        drawn = views(found, min(count, 1000), seed)
        q = np.concatenate([drawn] * (count // len(drawn)))
        block = complete_camera(found.cell.nominal, photograph(found, q, NOISE, seed))
        before, started = _memory(), time.process_time()
        done = fitted(found.cell.nominal, block)
        assert isinstance(block, Pixels)
        result[str(count)] = {
            "corners": int(block.seen.sum()), "parameters": len(done.free),
            "processor_seconds": time.process_time() - started,
            "memory_MB": _memory(), "memory_before_MB": before,
        }  # fmt: skip
    return result


def repeated(found: CameraCell, seeds: int, images: int = 40) -> dict[str, Any]:
    """Return the coverage of 95 % intervals, and the tool errors [mm] of both kinds of fit, over seeds.

    The hidden arm differs from the nominal in what images can tell alone, so that estimates compare with the truth.
    """
    nominal, truth = found.cell.nominal, found.cell.truth
    inside, rows = list[np.ndarray](), list[dict[str, float]]()
    told = None
    for seed in range(seeds):
        block = complete_camera(nominal, photograph(found, views(found, images, seed), NOISE, seed))
        result = fitted(nominal, block)
        if told is None:  # the others are merged into placements: keep them at nominal, and begin anew
            told = np.isin(np.arange(len(nominal.values)), result.free)
            own = nominal.with_values(np.where(told, truth.chain.values, nominal.values))
            found = replace(found, cell=replace(found.cell, truth=replace(truth, chain=own)))
            block = complete_camera(nominal, photograph(found, views(found, images, seed), NOISE, seed))
            result = fitted(nominal, block)
        assert isinstance(block, Pixels)
        true = {**dict(zip(layout(found.cell.truth).names, found.cell.truth.chain.values))}
        true |= {f"{block.camera}.{name}": value for name, value in zip(found.lens.names, found.lens.values)}
        known = [k for k, name in enumerate(result.estimate.names) if name in true]
        off = result.estimate.values[known] - [true[result.estimate.names[k]] for k in known]
        inside.append(np.abs(off) <= 1.96 * result.estimate.sigma[known])
        two = fitted(nominal, pnp_poses(block))
        one, other = (position_errors(found.cell, each.cell, each.cell.chain)[2] for each in (result, two))
        rows.append({"seed": seed, "inside": float(inside[-1].mean()), "reprojection_mm": one, "two_steps_mm": other})
    ratios = np.array([row["two_steps_mm"] / row["reprojection_mm"] for row in rows])
    return {
        "images": images, "seeds": rows, "parameters": len(inside[0]),
        "coverage_of_95_percent": float(np.mean(np.concatenate(inside))),
        "two_steps_over_reprojection": {
            "median": float(np.median(ratios)), "least": float(ratios.min()), "most": float(ratios.max()),
            "share_better": float(np.mean(ratios > 1.0)),
        },
    }  # fmt: skip


def _memory() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def study(out: Path, seed: int, quick: bool, say: Callable[[str], None]) -> dict[str, Any]:
    """Run the whole study; return the content of ``metrics.json``."""
    counts = (20, 24) if quick else COUNTS
    instrument = SimulatedInstrument("camera", encoder_sigma=ENCODER)
    hidden = virtual_cell("lwr4plus", instrument=instrument)
    lens, sought = (SMALL, Views((0.3, 0.55))) if quick else (FIVE_MEGAPIXEL, Views())
    stiff, real = (camera_cell(each, IN_HAND, lens=lens) for each in (rigid(hidden), hidden))
    say("images")
    images, rate = rendered(stiff, out / "images", max(counts), seed, sought)
    say("fits")
    return {
        "images": {"size": lens.size, "corners": int(images.seen.sum()), "detected_per_processor_second": rate},
        "rigid arm, rendered images": accuracy(stiff, images, counts, seed),
        "hidden deflections, projected corners": accuracy(
            real, photograph(real, views(real, max(counts), seed, sought), NOISE, seed), counts, seed
        ),
    }


def main() -> None:
    """Read the command line, run, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--speed", action="store_true")
    parser.add_argument("--seeds", type=int, default=0)
    given = parser.parse_args()
    if given.seeds:
        instrument = SimulatedInstrument("camera", encoder_sigma=ENCODER)
        over = repeated(camera_cell(rigid(virtual_cell("lwr4plus", instrument=instrument))), given.seeds)
        files.write_json(given.out / "seeds.json", over)
        table = [list(map(str, row.values())) for row in over["seeds"]]
        files.write_table(given.out / "seeds.csv", list(over["seeds"][0]), table)
        ratio = over["two_steps_over_reprojection"]
        print(
            f"{given.seeds} seeds of {over['images']} images: {over['coverage_of_95_percent']:.1%} of "
            f"{over['parameters']} parameters' true values lie in their 95 % intervals; error of two steps over that "
            f"of reprojection: median {ratio['median']:.2f}, {ratio['least']:.2f} to {ratio['most']:.2f}, reprojection "
            f"better in {ratio['share_better']:.0%}"
        )
        return
    if given.speed:
        counts = (50,) if given.quick else (200, 1000, 5000)
        timed = speed(camera_cell(rigid(virtual_cell("lwr4plus"))), counts, given.seed)
        files.write_json(given.out / "speed.json", timed)
        for count, row in timed.items():
            size = f"{row['parameters']} parameters: {row['processor_seconds']:.2f} s, {row['memory_MB']:.0f} MB"
            print(f"fit of {count} images, {size}")
        return
    found = study(given.out, given.seed, given.quick, print)
    files.write_json(given.out / "metrics.json", found)
    for name in ("rigid arm, rendered images", "hidden deflections, projected corners"):
        print(f"{name}: nominal {found[name]['nominal_mm']:.3f} mm; tool error [mm] by images")
        for count, row in found[name].items():
            if count != "nominal_mm":
                print(
                    f"  {count:>3}: reprojection {row['reprojection_mm']:.4f}, two steps {row['two_steps_mm']:.4f}, "
                    f"tracker {row['tracker_same_postures_mm']:.4f} (anywhere {row['tracker_anywhere_mm']:.4f})"
                )
    print(f"{found['images']['detected_per_processor_second']:.1f} images per processor second")


if __name__ == "__main__":
    main()
