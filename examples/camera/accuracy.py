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

import calib
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
from calib.simulation.cell import Cell, measure
from calib.simulation.truth import position_errors
from calib.simulation.virtual_cells import rigid, virtual_cell
from calib.transforms import pose

COUNTS = (20, 40, 80)
QUICK_COUNTS = (20, 24)
SEED_IMAGES = 40  # of a fit whose seeds are compared
SPEED_COUNTS = (200, 1000, 5000)
MAX_VIEWS = 1000  # different postures of a fit that is timed
SMALL = Lens("pinhole", np.array([780.0, 782.0, 400.0, 298.0, -0.12, 0.05, 4e-4, -3e-4, 0.0]), (800, 600))
ENCODER = 1e-5  # noise of the joint values [rad]
NOISE = 0.05  # of projected corners [px]
CAMERA = calib.SimulatedInstrument("camera", encoder_sigma=ENCODER)
TRACKER = calib.SimulatedInstrument("laser tracker", 20e-6, None, encoder_sigma=ENCODER)
RENDERED = "rigid arm, rendered images"
PROJECTED = "hidden deflections, projected corners"


def fit_geometry(chain: Any, block: PoseMeasurements) -> GeometricFit:
    """Return the fit of the full geometry to one block of images or poses."""
    start = install(chain, [block])
    return fit(start, [block], layout(start).rigid_index)


def fit_two_steps(chain: Any, images: Pixels) -> GeometricFit:
    """Return the fit of the full geometry to poses that PnP finds in images."""
    return fit_geometry(chain, pnp_poses(images))


def tool_error(cell: Cell, result: GeometricFit) -> float:
    """Return the error [mm rms] of the tool's position by a fit against the hidden truth."""
    return position_errors(cell, result.cell, result.cell.chain)[2]


def tracked(cell: Cell, q: np.ndarray, seed: int) -> PoseMeasurements:
    """Return the positions of a reflector next to the camera, measured by a tracker."""
    station = pose(None, [2.5, 1.0, 0.5])
    reflector = pose(None, [0.05, 0.0, 0.08])
    truth = replace(cell.truth, stations=station[None], tools=reflector[None])
    return measure(replace(cell, truth=truth, instrument=TRACKER), q, seed)


def as_pixels(block: PoseMeasurements) -> Pixels:
    """Return a block that is known to hold image corners."""
    assert isinstance(block, Pixels)
    return block


def accuracy(camera: CameraCell, images: Pixels, counts: tuple[int, ...], seed: int) -> dict[str, Any]:
    """Return the tool errors [mm] by number of images and kind of fit, with the σ stated by the fit."""
    cell = camera.cell
    nominal = cell.nominal
    table: dict[str, Any] = {}
    for count in counts:
        rows = np.arange(count)
        block = as_pixels(complete_camera(nominal, take(images, rows)))
        assert block.sigma is not None
        result = fit_geometry(nominal, block)
        noise = result.pieces[0].part.noise  # type: ignore[attr-defined]
        same_postures = tracked(cell, images.q[rows], seed)
        anywhere = tracked(cell, random_joints(nominal, count, seed + 1), seed)
        table[str(count)] = {
            "reprojection_mm": tool_error(cell, result),
            "two_steps_mm": tool_error(cell, fit_two_steps(nominal, block)),
            "tracker_same_postures_mm": tool_error(cell, fit_geometry(nominal, same_postures)),
            "tracker_anywhere_mm": tool_error(cell, fit_geometry(nominal, anywhere)),
            "corner_px": float(noise.factor * np.nanmedian(block.sigma)),
            "per_image": {"displacement_mm": 1e3 * noise.displacement, "turn_mrad": 1e3 * noise.turn},
        }
    table["nominal_mm"] = position_errors(cell, result.cell, result.cell.chain)[0]
    return table


def rendered(camera: CameraCell, folder: Path, count: int, seed: int, sought: Views) -> tuple[Pixels, float]:
    """Return the corners detected in rendered images, and the number of images per processor second."""
    if not (folder / "joints.csv").exists():
        take_pictures(camera, views(camera, count, seed, sought), folder, seed=seed)
    (folder / "corners.csv").unlink(missing_ok=True)
    started = time.process_time()
    names = [path.name for path in sorted(folder.glob("*.png"))]
    find_corners(folder, camera.board, names)
    rate = len(names) / (time.process_time() - started)
    return read_images(folder, camera.cell.nominal.joint_names), rate


def speed(camera: CameraCell, counts: tuple[int, ...], seed: int) -> dict[str, Any]:
    """Return processor seconds and memory of fits to many images with all corners in view."""
    result: dict[str, Any] = {}
    for count in counts:
        postures = views(camera, min(count, MAX_VIEWS), seed)
        q = np.concatenate([postures] * (count // len(postures)))
        block = as_pixels(complete_camera(camera.cell.nominal, photograph(camera, q, NOISE, seed)))
        memory_before = _memory()
        started = time.process_time()
        fitted = fit_geometry(camera.cell.nominal, block)
        result[str(count)] = {
            "corners": int(block.seen.sum()),
            "parameters": len(fitted.free),
            "processor_seconds": time.process_time() - started,
            "memory_MB": _memory(),
            "memory_before_MB": memory_before,
        }
    return result


def identifiable_cell(camera: CameraCell, images: int) -> CameraCell:
    """Return the cell with a hidden arm that differs from the nominal in what images identify alone.

    Other parameters are merged into placements; they stay nominal, so that estimates compare with the truth.
    """
    nominal = camera.cell.nominal
    truth = camera.cell.truth
    block = complete_camera(nominal, photograph(camera, views(camera, images, 0), NOISE, 0))
    identifiable = np.isin(np.arange(len(nominal.values)), fit_geometry(nominal, block).free)
    values = np.where(identifiable, truth.chain.values, nominal.values)
    hidden = replace(truth, chain=nominal.with_values(values))
    return replace(camera, cell=replace(camera.cell, truth=hidden))


def true_values(camera: CameraCell, block: Pixels) -> dict[str, float]:
    """Return the true parameters of arm and lens by their names in the estimate."""
    truth = camera.cell.truth
    values = dict(zip(layout(truth).names, truth.chain.values))
    for name, value in zip(camera.lens.names, camera.lens.values):
        values[f"{block.camera}.{name}"] = value
    return values


def inside_intervals(result: GeometricFit, true: dict[str, float]) -> np.ndarray:
    """Return whether each parameter whose true value is known lies in its 95 % interval."""
    estimate = result.estimate
    known = [k for k, name in enumerate(estimate.names) if name in true]
    errors = estimate.values[known] - [true[estimate.names[k]] for k in known]
    return np.abs(errors) <= 1.96 * estimate.sigma[known]


def repeated(camera: CameraCell, seeds: int, images: int = SEED_IMAGES) -> dict[str, Any]:
    """Return the coverage of 95 % intervals, and the tool errors [mm] of both kinds of fit, over seeds."""
    camera = identifiable_cell(camera, images)
    nominal = camera.cell.nominal
    inside: list[np.ndarray] = []
    rows: list[dict[str, float]] = []
    ratios = []
    for seed in range(seeds):
        corners = photograph(camera, views(camera, images, seed), NOISE, seed)
        block = as_pixels(complete_camera(nominal, corners))
        result = fit_geometry(nominal, block)
        inside.append(inside_intervals(result, true_values(camera, block)))
        reprojection = tool_error(camera.cell, result)
        two_steps = tool_error(camera.cell, fit_two_steps(nominal, block))
        row = {"seed": seed, "inside": float(inside[-1].mean())}
        rows.append(row | {"reprojection_mm": reprojection, "two_steps_mm": two_steps})
        ratios.append(two_steps / reprojection)
    return {
        "images": images,
        "seeds": rows,
        "parameters": len(inside[0]),
        "coverage_of_95_percent": float(np.mean(np.concatenate(inside))),
        "two_steps_over_reprojection": {
            "median": float(np.median(ratios)),
            "least": float(np.min(ratios)),
            "most": float(np.max(ratios)),
            "share_better": float(np.mean(np.array(ratios) > 1.0)),
        },
    }


def _memory() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def study(out: Path, seed: int, quick: bool, say: Callable[[str], None]) -> dict[str, Any]:
    """Run the whole study; return the content of ``metrics.json``."""
    counts, lens, sought = COUNTS, FIVE_MEGAPIXEL, Views()
    if quick:
        counts, lens, sought = QUICK_COUNTS, SMALL, Views((0.3, 0.55))
    deflecting = virtual_cell("lwr4plus", instrument=CAMERA)
    rigid_camera = camera_cell(rigid(deflecting), IN_HAND, lens=lens)
    deflecting_camera = camera_cell(deflecting, IN_HAND, lens=lens)
    say("images")
    images, rate = rendered(rigid_camera, out / "images", max(counts), seed, sought)
    say("fits")
    postures = views(deflecting_camera, max(counts), seed, sought)
    projected = photograph(deflecting_camera, postures, NOISE, seed)
    return {
        "images": {"size": lens.size, "corners": int(images.seen.sum()), "detected_per_processor_second": rate},
        RENDERED: accuracy(rigid_camera, images, counts, seed),
        PROJECTED: accuracy(deflecting_camera, projected, counts, seed),
    }


def run_seeds(out: Path, seeds: int) -> None:
    """Repeat a fit over seeds; write ``seeds.json`` and ``seeds.csv``, print a summary."""
    cell = rigid(virtual_cell("lwr4plus", instrument=CAMERA))
    result = repeated(camera_cell(cell), seeds)
    files.write_json(out / "seeds.json", result)
    table = [[str(value) for value in row.values()] for row in result["seeds"]]
    files.write_table(out / "seeds.csv", list(result["seeds"][0]), table)
    ratio = result["two_steps_over_reprojection"]
    print(
        f"{seeds} seeds of {result['images']} images: {result['coverage_of_95_percent']:.1%} of "
        f"{result['parameters']} parameters' true values lie in their 95 % intervals; error of two steps over that "
        f"of reprojection: median {ratio['median']:.2f}, {ratio['least']:.2f} to {ratio['most']:.2f}, reprojection "
        f"better in {ratio['share_better']:.0%}"
    )


def run_speed(out: Path, seed: int, counts: tuple[int, ...]) -> None:
    """Time fits to many images; write ``speed.json``, print a line per fit."""
    result = speed(camera_cell(rigid(virtual_cell("lwr4plus"))), counts, seed)
    files.write_json(out / "speed.json", result)
    for count, row in result.items():
        print(
            f"fit of {count} images, {row['parameters']} parameters: {row['processor_seconds']:.2f} s, "
            f"{row['memory_MB']:.0f} MB"
        )


def run_study(out: Path, seed: int, quick: bool) -> None:
    """Run the whole study; write ``metrics.json``, print its tables."""
    result = study(out, seed, quick, print)
    files.write_json(out / "metrics.json", result)
    for name in (RENDERED, PROJECTED):
        print(f"{name}: nominal {result[name]['nominal_mm']:.3f} mm; tool error [mm] by images")
        for count, row in result[name].items():
            if count != "nominal_mm":
                print(
                    f"  {count:>3}: reprojection {row['reprojection_mm']:.4f}, two steps {row['two_steps_mm']:.4f}, "
                    f"tracker {row['tracker_same_postures_mm']:.4f} (anywhere {row['tracker_anywhere_mm']:.4f})"
                )
    print(f"{result['images']['detected_per_processor_second']:.1f} images per processor second")


def main() -> None:
    """Read the command line, run, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--speed", action="store_true")
    parser.add_argument("--seeds", type=int, default=0)
    options = parser.parse_args()
    if options.seeds:
        run_seeds(options.out, options.seeds)
    elif options.speed:
        run_speed(options.out, options.seed, (50,) if options.quick else SPEED_COUNTS)
    else:
        run_study(options.out, options.seed, options.quick)


if __name__ == "__main__":
    main()
