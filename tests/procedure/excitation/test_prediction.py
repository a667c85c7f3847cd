"""What a motion is said to tell, before it is played: held against what an identification states afterwards."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from calib.data.recordings.recording import Recording
from calib.errors import UsageError
from calib.identification.identify_options import IdentifyOptions
from calib.identification.uncertainty.error_bands import ErrorBands
from calib.identification.uncertainty.geometry_uncertainty import propagate
from calib.procedure.dynamic_stage import identify, inputs
from calib.procedure.dynamic_stage.folder import write_folder
from calib.procedure.excitation import design, prediction, prior_motions
from calib.procedure.excitation import folder as motion_folder
from calib.procedure.excitation.excited_model import ExcitedModel
from calib.procedure.excitation.geometry_spread import geometry_spread
from calib.procedure.excitation.inputs import ExcitationInputs, read_inputs
from calib.procedure.excitation.prediction import (
    ADDED_ERRORS,
    _information_root,
    _reweighted,
    _wider,
    known_sigmas,
    task_of,
)
from calib.procedure.excitation.settings import ExcitationSettings
from calib.robot.calibrated import CalibratedChain

SHORT = ExcitationSettings(
    starts=1, evaluations=10, period=10.0, harmonics=4, rate=100.0, samples=100, repeat=2,
    drives="Ia Fv Fc off",
)  # fmt: skip


@pytest.fixture(scope="module")
def designed() -> design.Designed:
    return design.excite("lwr4plus", SHORT)


@pytest.fixture(scope="module")
def motion(designed: design.Designed, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return motion_folder.write_design(designed, tmp_path_factory.mktemp("designed") / "e")


@pytest.fixture(scope="module")
def outcome(designed: design.Designed) -> identify.IdentificationOutcome:
    """An identification of the motion, its torques as wrong in the band as was said: by white noise."""
    run, model, outlook = designed.playback.run, designed.inputs.model, designed.outlook
    assert outlook is not None and model.values is not None
    band = outlook.own.rows_per_joint / outlook.own.seconds / 2
    noise = np.random.default_rng(0).normal(size=run.q.shape) * outlook.noise / np.sqrt(2 * band / run.rate)
    names = model.exact.names
    friction = [
        0.05 * designed.inputs.limits.torque[int(name[2]) - 1] if name[:2] in ("Fv", "Fc") else 0.0 for name in names
    ]
    tau = model.exact.regressor(run.q, run.v, run.a) @ (model.values + friction) + noise
    log = Recording(run.times, run.q, tau, "torque", tuple(designed.inputs.chain.joint_names))
    options = IdentifyOptions()
    options = replace(options, settings=replace(options.settings, friction="standard", prior="none", method="wls"))
    return identify.run(inputs.gather("lwr4plus", [log], options=options))


@pytest.mark.slow
def test_geometry_part_is_of_identification(designed, outcome):
    """Of independent errors of all elements: sigma_geometry as `propagate` finds it from the log."""
    chain, given = outcome.inputs.chain, designed.inputs
    sizes = np.where(np.array(chain.units) == "m", 2e-4, 1e-3)
    robot = CalibratedChain(chain, covariance=np.diag(sizes**2))
    spread = geometry_spread(robot, Path("robot.toml"), chain, given.model, None)
    quick = replace(SHORT, outlook=False)
    rows = prediction.foretell(
        replace(given, geometry=spread), quick, designed.problem, designed.found, lambda _: None
    )[1]
    stated = dict(zip(outcome.found.names, propagate(outcome.found, robot, outcome.inputs.cases).sigma_geometry))
    ratios = [row.sigma_geometry / stated[row.name] for row in rows if row.name in stated]
    assert len(ratios) > 40 and 0.9 < np.median(ratios) < 1.1 and np.quantile(np.abs(np.log(ratios)), 0.9) < 0.3


@pytest.mark.slow
def test_stated_sigmas_are_near_predicted(motion, outcome):
    """The sigmas stated are those predicted, within a factor."""
    with (motion / prediction.NAME).open() as file:
        promised = {line.split(",")[0]: float(line.split(",")[3]) for line in file.readlines()[1:]}
    found = outcome.found
    ratios = [sigma / promised[name] for name, sigma in zip(found.names, found.fitted.estimate.sigma)]
    assert 0.85 < np.median(ratios) < 1.2
    assert np.quantile(ratios, 0.05) > 0.7 and np.quantile(ratios, 0.95) < 1.4
    said = prediction.compared_with_identification(motion, outcome)
    assert f"({len(found.names)} parameters): median {np.median(ratios):.2g}" in said and "1 % assumed" in said


def test_longer_motion_tells_more(designed, motion):
    """Longer motion tells more, and the figures are in the folder."""
    outlook = designed.outlook
    shares = {round(one.seconds): one.torque_sigma_share for one in outlook.by_period}
    assert set(shares) >= {10, 20, 40} and shares[20] == pytest.approx(shares[10] / np.sqrt(2))
    assert shares[20] == pytest.approx(outlook.own.torque_sigma_share)  # two periods of 10 s are run
    stored = json.loads((motion / "metrics.json").read_text())["prediction"]
    assert stored["own"]["torque_sigma_share"] == pytest.approx(shares[20])
    assert [one["seconds"] for one in stored["by_period"]][-2:] == [20.0, 40.0]


def test_sigmas_go_with_the_noise(designed):
    noisy, motion = replace(SHORT, noise=0.03, outlook=False), (designed.problem, designed.found)
    more, rows = prediction.foretell(designed.inputs, noisy, *motion, lambda period: designed.problem)
    assert [row.sigma for row in rows] == pytest.approx([3 * row.sigma for row in designed.predicted])
    assert more.by_period == ()


@pytest.mark.slow
def test_missing_prediction_is_refused(motion, outcome, tmp_path):
    """A folder without a prediction is refused."""
    with pytest.raises(UsageError, match=r"has no prediction\.csv"):
        prediction.check_folder(tmp_path)
    fitted = SimpleNamespace(estimate=SimpleNamespace(sigma=np.ones(2)))
    other = replace(outcome, found=SimpleNamespace(names=["one", "two"], fitted=fitted))
    with pytest.raises(UsageError, match="none of the 2 identified parameters"):
        prediction.compared_with_identification(motion, other)


@pytest.mark.parametrize("density", [np.ones((1, 3)), np.ones((2, 2)), np.zeros((2, 3))])
def test_damaged_error_bands_are_refused(monkeypatch, tmp_path, density):
    metrics = SimpleNamespace(error_bands=ErrorBands(np.array([10.0, 20.0]), density))
    monkeypatch.setattr(prior_motions, "IdentificationFolder", lambda folder: SimpleNamespace(metrics=lambda: metrics))
    model = SimpleNamespace(exact=SimpleNamespace(model=SimpleNamespace(rows=3), loads=("",)))
    with pytest.raises(UsageError, match="error_bands is damaged; identify again"):
        prior_motions._bands(tmp_path, cast(ExcitedModel, model))


def test_earlier_rows_are_weighed_by_the_rows_that_see_a_parameter():
    """Of three parameters each row sees one; the third is moved by neither, as by the friction of a locked joint."""
    whitened = np.zeros((2, 2, 3))
    whitened[:, 0, 0] = 3.0
    whitened[:, 1, 1] = 5.0
    factor = _reweighted(whitened, np.array([2.0, 4.0]))
    assert factor == pytest.approx([1 / 2, 1 / 4, 1 / 4])


@pytest.mark.parametrize("earlier", [30.0, 0.0], ids=["stated time", "file without a time"])
@pytest.mark.parametrize("existing", [0.0, 10.0], ids=["a further motion", "another one beside"])
def test_added_errors_count_by_the_time_that_is_new(existing, earlier):
    """Earlier recordings keep their variance; motions that are not identified have `ADDED_ERRORS` times it."""
    bands = ErrorBands(np.array([50.0]), np.ones((1, 2)), seconds=earlier)
    inputs = cast(ExcitationInputs, SimpleNamespace(prior=SimpleNamespace(bands=bands, seconds=existing)))
    variance = (earlier + (existing + 10.0) * ADDED_ERRORS) / (earlier + existing + 10.0)
    assert _wider(inputs, np.zeros((5, 2, 3)), band=5.0, seconds=10.0) ** 2 == pytest.approx([variance, variance])


def _stored(information: np.ndarray, data: np.ndarray | None) -> ExcitationInputs:
    """Return inputs that have an identification's information alone."""
    kept = np.arange(len(information))
    stored = SimpleNamespace(
        columns=SimpleNamespace(kept=kept), prior=SimpleNamespace(information=information, data=data)
    )
    return cast(ExcitationInputs, stored)


def test_priors_are_not_weighed_with_the_rows():
    data = np.array([[4.0, 1.0], [1.0, 2.0]])
    priors = np.diag([0.5, 3.0])
    factor = np.array([0.5, 0.25])
    root = _information_root(_stored(data + priors, data), factor)
    np.testing.assert_allclose(root.T @ root, data * np.outer(factor, factor) + priors)


def test_switched_off_term_is_no_column_of_a_design(outcome, tmp_path):
    """Neither of the model, nor of what is known; the other parameters keep their σ."""
    path = write_folder(outcome, tmp_path / "dynamics")
    metrics = json.loads((path / "metrics.json").read_text())
    (path / "metrics.json").write_text(json.dumps(metrics | {"switched_off": ["Fc7"]}))
    estimated = outcome.found.names
    factor = np.random.default_rng(0).normal(size=(len(estimated), len(estimated) + 1))
    np.savetxt(path / "information.csv", factor, delimiter=",", header=",".join([*estimated, "y"]), comments="")
    inputs = read_inputs("lwr4plus", ExcitationSettings(), after=path)
    names = inputs.columns.names
    assert set(estimated) - set(names) == {"Fc7"}
    # its rows tell the others as if the term were not there
    index = [estimated.index(name) for name in names]
    assert inputs.prior is not None and inputs.prior.information.shape == (len(names), len(names))
    np.testing.assert_allclose(inputs.prior.data, factor[:, index].T @ factor[:, index], atol=1e-9)
    sigmas = dict(zip(estimated, outcome.found.fitted.estimate.sigma))
    _, sigmas_before = known_sigmas(inputs, task_of(inputs, 0))
    assert sigmas_before == pytest.approx([sigmas[name] for name in names], rel=1e-3)


def test_what_is_known_to_rounding_does_not_drown_the_rest():
    """A constraint holds the third parameter; the information on the others is 24 decimals less."""
    information = np.array([[4.0, 1.0, 0.0], [1.0, 2.0, 0.0], [0.0, 0.0, 1e24]])
    root = _information_root(_stored(information, None))
    np.testing.assert_allclose((root.T @ root)[:2, :2], information[:2, :2], rtol=1e-9)


@pytest.mark.parametrize("data", [None, np.diag([8.0, 1.0])], ids=["no rows stored", "covariance of more than torques"])
def test_all_information_is_weighed_where_the_priors_share_is_not_known(data):
    information = np.array([[4.0, 1.0], [1.0, 2.0]])
    factor = np.array([0.5, 0.25])
    root = _information_root(_stored(information, data), factor)
    np.testing.assert_allclose(root.T @ root, information * np.outer(factor, factor))
