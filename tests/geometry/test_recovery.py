"""Recovery: planted arms come back within the covariance the fit states, for every kind of measurement and mixtures."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.stats
from planted import cell, deviation, load, measure, perturb, position_error, random_joints

from calib.data.poses.measurements import take
from calib.estimation import robust
from calib.geometry.first_guess import install
from calib.geometry.fit import fit, polish_frames
from calib.geometry.installation import Installation, see
from calib.geometry.observability import unidentified
from calib.geometry.observation import layout
from calib.geometry.weighing import Settings

SIGMA = 5e-5
SEEDS = 24


def one_kind(kind: str, count: int):
    return lambda truth, seed, sigma, more: [measure(truth, kind, count * more, seed, sigma=sigma)]


def sockets(truth, seed, sigma, more):
    """Sockets whose distances are not known: the arm's scale is a gauge, as with planes."""
    return [replace(block, links=()) for block in one_kind("sockets", 96)(truth, seed, sigma, more)]


def two_stations(truth, seed, sigma, more):
    """Poses of one tool from a camera, positions of another from a tracker that is three times as good."""
    first = measure(truth, "pose", 30 * more, seed, sigma=sigma, sigma_rotation=4 * sigma, file="camera")
    second = measure(truth, "position", 40 * more, seed + 1000, sigma=sigma / 3, station=1, tools=(1,), file="tracker")
    return [first, second]


def three_reflectors(truth, seed, sigma, more):
    return [measure(truth, "position", 60 * more, seed, sigma=sigma, tools=(0, 1, 2))]


def poses_and_distances(truth, seed, sigma, more):
    first = measure(truth, "pose", 25 * more, seed, sigma=3 * sigma)
    return [first, measure(truth, "distance", 80 * more, seed + 1000, sigma=sigma, tools=(1,))]


SCENES = {
    "pose": (one_kind("pose", 40), 1, 1),
    "position": (one_kind("position", 60), 1, 1),
    "distance": (one_kind("distance", 200), 1, 1),
    "sockets": (sockets, 1, 1),
    "plane": (one_kind("plane", 200), 1, 1),
    "bar": (one_kind("bar", 180), 1, 1),
    "two stations": (two_stations, 2, 2),
    "three reflectors": (three_reflectors, 1, 3),
    "poses and distances": (poses_and_distances, 1, 2),
}
QUICK = ("pose",)


def planted(name: str, seed: int, robot: str = "ur5"):
    """Return nominal chain, truth, noisy measurements and exact ones at other joints."""
    scene, stations, tools = SCENES[name]
    nominal = load(robot)
    station_names, tool_names = ("station", "second")[:stations], ("tool", "other", "third")[:tools]
    truth = cell(perturb(nominal, seed, 0.5e-3, 1e-3), seed, station_names, tool_names)
    return nominal, truth, scene(truth, seed, SIGMA, 1), scene(truth, seed + 500, 0.0, 2)


def calibrate(nominal, measured, settings=None):
    start = polish_frames(install(nominal, measured), measured, settings)
    return fit(start.cell, measured, settings=settings)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in SCENES]
)
def test_errors_follow_stated_covariance(name):
    """dxᵀ C⁻¹ dx / p is Fisher's F(p, dof), C being scaled by the residuals; two-sided, at four standard errors."""
    scores, squares, freedom = [], 0.0, 0
    seeds = SEEDS // 2 if name in ("sockets", "plane") else SEEDS  # touching takes inverse kinematics, hence time
    for seed in range(seeds):
        nominal, _, measured, exact = planted(name, seed)
        found = calibrate(nominal, measured)
        assert found.solution.status.good
        size, rest = deviation(found, exact)
        assert rest < 0.02, f"seed {seed}: {rest:.3f} of the error is in no fitted parameter"
        p, dof = found.identified, found.estimate.dof
        scores.append(scipy.stats.norm.ppf(scipy.stats.f(p, dof).cdf(size / p)))
        squares += dof * found.estimate.residual_std**2
        freedom += dof
    assert abs(np.sum(scores)) < 4 * np.sqrt(seeds), f"normal scores {np.round(scores, 1)}"
    assert abs(squares - freedom) < 4 * np.sqrt(2 * freedom)  # the stated sigmas are those of the residuals


@pytest.mark.parametrize("robot", ["lwr4plus", pytest.param("ur5", marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", ["pose", "position"])
def test_predictions_beat_one_measurement(robot, kind):
    """Error of the prediction: sigma sqrt(p / rows), about; the nominal arm is 20 times off."""
    nominal = load(robot)
    for seed in range(3):
        truth = cell(perturb(nominal, seed, 0.5e-3, 1e-3), seed)
        measured = measure(truth, kind, 100, seed, sigma=SIGMA, sigma_rotation=1e-4)
        start = polish_frames(install(nominal, [measured]), [measured])
        found = fit(start.cell, [measured])
        q = random_joints(nominal, 300, 77)
        error = np.sqrt(np.mean(position_error(found.cell, truth, q) ** 2))
        expected = SIGMA * np.sqrt(found.identified / 100)
        assert error < 1.6 * expected
        assert np.sqrt(np.mean(position_error(start.cell, truth, q) ** 2)) > 10 * error


@pytest.mark.parametrize(
    "name",
    [
        "pose",
        pytest.param("position", marks=pytest.mark.slow),
        "sockets",
        pytest.param("distance", marks=pytest.mark.slow),
    ],
)
def test_exact_rows_give_the_truth(name):
    """Without noise the truth is found to rounding."""
    scene = SCENES[name][0]
    nominal = load("lwr4plus")
    measured = scene(cell(perturb(nominal, 5, 1e-3, 2e-3), 1), 1, 0.0, 1)
    found = calibrate(nominal, measured)
    assert max(np.abs(part.value).max() for part in (piece.part for piece in found.pieces)) < 1e-8


@pytest.mark.parametrize(
    ("name", "seeds"),
    [
        pytest.param("position", 6, marks=pytest.mark.slow),
        *(pytest.param(name, SEEDS, marks=pytest.mark.slow) for name in ("pose", "position")),
    ],
)
def test_unstated_sigmas_are_estimated(name, seeds):
    """Position and orientation each get their own, within the scatter that so many rows allow."""
    ratios = []
    for seed in range(seeds):
        nominal = load("ur5")
        truth = cell(perturb(nominal, seed, 0.5e-3, 1e-3), seed)
        measured = measure(truth, name, 80, seed, sigma=SIGMA, sigma_rotation=2e-4, stated=False)
        told = measure(truth, name, 80, seed, sigma=SIGMA, sigma_rotation=2e-4)
        found, known = calibrate(nominal, [measured]), calibrate(nominal, [told])
        true = {"position": SIGMA, "orientation": 2e-4}
        ratios.append([piece.sigma.mean() / true[piece.part.label] for piece in found.pieces])
        q = random_joints(nominal, 50, 9)  # other weights may choose other columns for the same arm
        assert position_error(found.cell, known.cell, q).max() < 0.5 * SIGMA
    assert np.mean(ratios, axis=0) == pytest.approx(1.0, abs=4 * 0.05 / np.sqrt(seeds))


def test_merging_parameters_share():
    """Base parameters are as many as ever; what displaces base or tool alone stays at nominal, the others share."""
    nominal, truth, measured, _ = planted("pose", 3)
    found = calibrate(nominal, measured)
    table = layout(found.cell)
    assert found.identified == found.split.rank == 30
    base = found.candidates[found.split.kept]
    merged = np.setdiff1d(table.index("arm"), base)
    assert len(merged) == len(nominal.elements) - (30 - 12)
    fixed = np.setdiff1d(merged, found.free)
    assert np.array_equal(found.cell.chain.values[fixed], nominal.values[fixed])
    sigma = dict(zip(found.free.tolist(), found.estimate.sigma))
    shared = np.intersect1d(merged, found.free)
    assert len(shared) and all(sigma[int(parameter)] > 3 * max(found.base_sigma()) for parameter in shared)
    q = random_joints(nominal, 50, 9)
    assert position_error(found.cell, truth, q).max() < 3 * SIGMA


def test_merging_order_does_not_matter():
    """Axis 5 is displaced along itself by a hair: joint 4's offset then moves the tool over that lever."""
    tips = []
    for lever in (0.0, 1e-4, 5e-4, 1e-2):
        nominal = load("ur5")
        values = nominal.values.copy()
        values[list(nominal.names).index("r5")] += lever
        nominal = nominal.with_values(values)
        truth = cell(perturb(nominal, 7, 0.5e-3, 1e-3), 7)
        found = calibrate(nominal, [measure(truth, "position", 60, 7, sigma=SIGMA)])
        tips.append(np.sqrt(np.mean(position_error(found.cell, truth, random_joints(nominal, 200, 9)) ** 2)))
    assert max(tips) < 1.5 * SIGMA, tips


def test_weakly_told_stays_near_nominal():
    """The wrist turns by a degree only: its offsets are determined on paper, with sigmas beyond what is plausible."""
    nominal = load("ur5")
    truth = cell(perturb(nominal, 1, 0.5e-3, 1e-3), 1)
    q = random_joints(nominal, 40, 1)
    q[:, 4] = 0.7 + 1e-3 * np.random.default_rng(0).normal(size=40)
    position = see(truth, q).point.T + 2e-4 * np.random.default_rng(2).normal(size=(40, 3))
    measured = replace(measure(truth, "position", 40, 1, sigma=2e-4), q=q, position=position)
    found = calibrate(nominal, [measured])
    table = layout(found.cell)
    arm = np.isin(found.free, table.index("arm"))
    assert np.all(found.estimate.sigma[arm] <= 1.001 * found.prior[arm])
    change = found.cell.chain.values - nominal.values
    assert np.all(np.abs(change[found.free[arm]]) < 4 * found.prior[arm])
    near = next(one for one in unidentified(found) if one.code == "near-prior")
    assert near.values["names"]


def test_both_solvers_end_at_the_same_arm():
    """Equation 11 and Levenberg-Marquardt end at the same arm."""
    nominal, _, measured, _ = planted("pose", 4)
    one = calibrate(nominal, measured)
    other = calibrate(nominal, measured, Settings(damping=0.0))
    assert list(one.free) == list(other.free)
    assert other.estimate.values == pytest.approx(one.estimate.values, abs=1e-3 * one.estimate.sigma.max())


def test_row_order_does_not_matter():
    """The order of rows and blocks does not matter."""
    nominal, _, measured, _ = planted("two stations", 5)
    rng = np.random.default_rng(0)
    mixed = [take(block, rng.permutation(len(block))) for block in measured[::-1]]
    one, other = calibrate(nominal, measured), calibrate(nominal, mixed)
    q = random_joints(nominal, 40)
    station = other.cell.station_names.index("station")
    tool = other.cell.tool_names.index("tool")
    aligned = Installation(other.cell.chain, other.cell.stations[[station]], other.cell.tools[[tool]])
    assert position_error(one.cell, aligned, q).max() < 1e-3 * SIGMA


@pytest.mark.slow
@pytest.mark.parametrize("loss", [pytest.param("huber", marks=pytest.mark.slow), "cauchy"])
def test_planted_outliers_are_named(loss):
    """Planted outliers are named with file and row, and hardly any others."""
    others = 0
    for seed in range(6):
        nominal = load("ur5")
        truth = cell(perturb(nominal, seed, 0.5e-3, 1e-3), seed)
        clean = measure(truth, "position", 100, seed, sigma=SIGMA, stated=False, file="tracker.csv")
        rng = np.random.default_rng(seed)
        hit = np.sort(rng.choice(100, 10, replace=False))
        position = clean.position.copy()
        position[hit] += rng.choice([-1, 1], (10, 3)) * rng.uniform(1e-3, 2e-2, (10, 3))
        dirty = replace(clean, position=position)
        found = calibrate(nominal, [dirty], Settings(loss=loss, passes=15))
        named = found.outliers()
        assert {item[0] for item in named} == {"tracker.csv"} and {item[2] for item in named} == {"position"}
        rows = {item[1] for item in named}
        assert set(hit + 1) <= rows
        others += len(rows) - 10
        assert [item[3] for item in named] == sorted((item[3] for item in named), reverse=True)
        q = random_joints(nominal, 100, 9)
        error = np.sqrt(np.mean(position_error(found.cell, truth, q) ** 2))
        plain = calibrate(nominal, [dirty])
        assert error < (3 if loss == "cauchy" else 8) * SIGMA * np.sqrt(27 / 90)
        assert np.sqrt(np.mean(position_error(plain.cell, truth, q) ** 2)) > 5 * error
    assert others <= 6  # of 540 good rows


@pytest.mark.slow
def test_a_clean_measurement_has_no_outliers():
    for seed in range(6):
        nominal, _, measured, _ = planted("position", seed)
        assert not calibrate(nominal, measured).outliers()


def test_outlier_is_beyond_4_robust_sigmas():
    """A row is an outlier beyond four robust sigmas per component."""
    nominal, _, measured, _ = planted("position", 1)
    found = calibrate(nominal, measured)
    for size, expected in ((3.8, []), (4.2, [8])):
        piece = found.pieces[0]
        value = piece.part.value.copy()
        value[:, 7] = size * robust.spread(value) * np.array([1.0, -1.0, 1.0])
        changed = replace(found, pieces=[replace(piece, part=replace(piece.part, value=value))])
        assert [item[1] for item in changed.outliers()] == expected


def test_prior_holds_where_it_is_tight():
    """A prior holds where it is tight and is not felt where it is loose."""
    nominal = load("ur5")
    measured = measure(cell(perturb(nominal, 3, 1e-3, 2e-3), 3), "pose", 60, 3, sigma=SIGMA, sigma_rotation=2e-4)
    start = polish_frames(install(nominal, [measured]), [measured]).cell
    place = list(nominal.names).index("theta3")
    prior = np.full(len(layout(start).names), np.inf)
    free = fit(start, [measured], prior=prior)
    prior[place] = 1e-9
    held = fit(start, [measured], prior=prior)
    prior[place] = 1.0
    loose = fit(start, [measured], prior=prior)
    assert abs(free.cell.chain.values[place] - nominal.values[place]) > 1e-4
    assert abs(held.cell.chain.values[place] - nominal.values[place]) < 1e-8
    q = random_joints(nominal, 50, 9)
    assert position_error(loose.cell, free.cell, q).max() < 0.1 * SIGMA
