"""Real recordings (see tests/recordings.py): the goals of the identification, on motion not used for the fit."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from without_figures import run

from calib.column_changes import coupling
from calib.identification.checks.recording_sizes import compare_sizes, signs_of
from calib.identification.identify_options import parse_options
from calib.identification.rows import Case
from calib.procedure.dynamic_stage import plausibility
from calib.procedure.dynamic_stage.inputs import gather, read_motion
from calib.procedure.dynamic_stage.recorded_gains import find_gains
from calib.robot.chain import Chain
from calib.robot.library import load


def identify(out: Path, *arguments: object, options: str = "") -> dict:
    """Run the command and return its metrics."""
    more: list[object] = []
    if options:
        out.parent.mkdir(parents=True, exist_ok=True)
        path = out.parent / "options.toml"
        path.write_text(options)
        more = ["--options", path]
    code = run("identify", *arguments, "--out", out, *more)
    found = json.loads((out / "metrics.json").read_text())
    assert code == (found["verdict"] == "fail")
    return found


def total(found: dict, name: str, part: str = "raw") -> float:
    group = found["validation"] if name in found["validation"] else found["identification"]
    return group[name][part]["relative_error_percent"]["total"]


def values(out: Path) -> dict[str, float]:
    with (out / "estimate.csv").open() as file:
        return {row["name"]: float(row["value"]) for row in csv.DictReader(file)}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("train", "unseen", "most", "plain"), [("@0:9.387", "@9.387:", 3.25, 3.55), ("@3.13:", "@0:3.13", 3.65, 4.2)]
)
def test_panda_on_the_rest_of_its_record(data, tmp_path, train, unseen, most, plain):
    """Measured 2.9 and 3.4 %; without richer friction and ripple 3.4 and about 4.0 %; published model 3.66 %.

    The issue's plain 2.8 % was not reproduced (another stretch, most likely): plain WLS left out second by second over
    all 12.5 s gives 2.93 beside the published model's 3.76. Its goal of 2.3 is not met here.
    """
    folder = data / "franka_panda_inria"
    log = folder / "traj1_first60pct.npz"
    found = identify(tmp_path / "out", folder / "model.urdf", f"{log}{train}", "--validate", f"{log}{unseen}")
    assert total(found, f"traj1_first60pct.npz{unseen}") < most
    bare = identify(
        tmp_path / "bare",
        folder / "model.urdf",
        f"{log}{train}",
        "--validate",
        f"{log}{unseen}",
        "--friction",
        "standard",
    )
    assert total(found, f"traj1_first60pct.npz{unseen}") < total(bare, f"traj1_first60pct.npz{unseen}") < plain
    lobes = {(wave["gear"], wave["order_per_turn"]) for one in found["ripple"] for wave in one["waves"]}
    assert {(1, 240), (1, 242), (4, 240), (4, 242)} <= lobes


@pytest.mark.slow
@pytest.mark.parametrize(("seconds", "most"), [(1, 6.5), (2, 5.5), (4, 4.2), (6, 3.3)])
def test_panda_on_the_first_seconds(data, tmp_path, seconds, most):
    """Measured 5.5, 4.8, 3.7 and 3.2 %; weighted least squares with its switches gave 481, 25, 7.3 and 3.3."""
    folder = data / "franka_panda_inria"
    log = folder / "traj1_first60pct.npz"
    unseen = f"{log}@9.387:11.9"
    found = identify(tmp_path / "out", folder / "model.urdf", f"{log}@0:{seconds}", "--validate", unseen)
    assert total(found, Path(unseen).name) < most


@pytest.mark.slow
@pytest.mark.parametrize(("end", "most"), [(10, 10.3), (12, 5.7), (16, 7.0), (24, 4.4)])
def test_ur10e_on_the_first_seconds(data, tmp_path, end, most):
    """Measured 9.7, 5.1, 5.3 and 4.1 %; weighted least squares with its switches: refused, 25, 7.8 and 4.1.

    The third is 6.7 % since standstills count once (another step of friction is taken, on two of them).
    """
    folder = data / "ur10e_innopolis"
    unseen = folder / "ur-20_02_19_14harm50sec.npz"
    train = f"{folder / 'ur-20_02_10-30sec_12harm.npz'}@8:{end}"
    gains = "gains = [14.87, 13.26, 11.13, 10.62, 11.03, 11.47]"
    found = identify(tmp_path / "out", folder / "model.urdf", train, "--validate", unseen, options=gains)
    assert total(found, unseen.name) < most


UR10E = """
[payload.load]
mass = 2.805
[gain_identification]
unloaded = "ur-20_02_19_14harm50sec.npz"
loaded = "ur-20_02_19_14harm50secLoad.npz"
[files."ur-20_02_19_14harm50secLoad.npz"]
payload = ["load"]
"""


@pytest.mark.slow
def test_ur10e_currents_become_torques(data, tmp_path):
    """The UR10e's currents become torques, and friction pays."""
    folder = data / "ur10e_innopolis"
    unseen = [folder / f"ur-20_02_19_14harm50sec{end}.npz" for end in ("", "Load")]
    train = folder / "ur-20_02_10-30sec_12harm.npz"
    arguments = (folder / "model.urdf", train, "--validate", *unseen)
    found = identify(tmp_path / "out", *arguments, options=UR10E)
    for path in unseen:
        assert total(found, path.name) < 3.8, "measured 3.61 and 3.24; the goal is 4.3"
    assert all(wave["order_per_turn"] in (100, 200, 202) for one in found["ripple"] for wave in one["waves"])
    kept = [rung["model"] for rung in found["ladder"] if rung["kept"]]
    assert {"+ load", "+ presliding"} <= set(kept)
    plain = identify(tmp_path / "plain", *arguments, "--friction", "standard", options=UR10E)
    assert total(found, unseen[0].name) < 0.85 * total(plain, unseen[0].name)


PAIRS = {
    "19_02": ("ur-20_02_19_14harm50sec.npz", "ur-20_02_19_14harm50secLoad.npz"),
    "31_01": ("ur-20_01_31-unload.npz", "ur-20_01_31-load.npz"),
}


def gains(folder: Path, pair: str) -> tuple[np.ndarray, np.ndarray]:
    """Return drive gains and their sigmas from one pair of runs."""
    unloaded, loaded = PAIRS[pair]
    options = parse_options(
        {"payload": {"load": {"mass": 2.805}}, "gain_identification": {"unloaded": unloaded, "loaded": loaded}}
    )
    chain = load(folder / "model.urdf")
    paths = [str(folder / name) for name in (unloaded, loaded)]
    motions = {path: read_motion(path, chain, options.file_settings(path)) for path in paths}
    found = find_gains(chain, options, motions, paths, lambda words: None).found
    assert found is not None
    return found.gains, found.sigma


@pytest.mark.slow
def test_ur10e_run_pairs_tell_the_same_gains(data):
    """Measured, of all joints: 10.8 12.3 10.0 10.4 10.2 10.3 and 11.8 12.6 10.1 10.4 10.0 9.5 N m/A.

    The load of the second pair is not stated and taken as the first's, which these gains confirm within 3 %.
    """
    (one, sigma), (other, beside) = (gains(data / "ur10e_innopolis", pair) for pair in PAIRS)
    assert (np.abs(one - other) < 2.0 * np.hypot(sigma, beside)).all()
    assert np.abs(one / other - 1.0)[1:4].max() < 0.03


@pytest.mark.slow
def test_ur10e_gains_serve_another_pair(data, tmp_path):
    """No run of the pair that is predicted told anything: neither gains nor the load."""
    folder = data / "ur10e_innopolis"
    options = UR10E
    for name, other in zip(*(PAIRS[pair] for pair in ("19_02", "31_01"))):
        options = options.replace(f'loaded = "{name}"', f'loaded = "{folder / other}"')
    unseen = [folder / name for name in PAIRS["19_02"]]
    train = folder / "ur-20_02_10-30sec_12harm.npz"
    found = identify(tmp_path / "out", folder / "model.urdf", train, "--validate", *unseen, options=options)
    for path in unseen:
        assert total(found, path.name) < 4.0, "measured 3.69 and 3.35; the goal is 4.3"


@pytest.mark.slow
def test_ur10e_currents_tell_what_they_can(data, tmp_path):
    """Measured 0.96 ± 0.14, 0.81 ± 0.02, 0.91 ± 0.15 and 0.84 ± 0.15 of joint 2's; of the last joint nothing."""
    folder = data / "ur10e_innopolis"
    train, unseen = (folder / f"ur-20_02_{name}harm.npz" for name in ("05-20sec_8", "10-30sec_12"))
    found = identify(
        tmp_path / "out", folder / "model.urdf", train, "--validate", unseen, "--friction", "standard"
    )  # fmt: skip
    told = found["drive_gains"]
    assert told["told"][5] == "not told" and told["values"][5] is None and told["sigma"][5] is None
    pair = gains(folder, "19_02")[0]
    values, sigma = (np.array(told[key], dtype=float)[[0, 2, 3, 4]] for key in ("values", "sigma"))
    away = (values - (pair / pair[1])[[0, 2, 3, 4]]) / sigma
    assert np.abs(away).max() < 2.0
    joints = found["validation"][unseen.name]["raw"]["relative_error_percent"]["joints"]
    assert total(found, unseen.name) < max(joints[:5]) and total(found, unseen.name) < 6.0


TX40 = """
friction = "standard"
slow = [0.05, 0.05, 0.075, 0.072, 0.056, 0.122]
v0 = 0.001
essential = "none"
[[coupling]]
joints = [5, 6]
label = "6"
[filter]
cutoff = 40.0
band = 20.0
"""


@pytest.mark.slow
def test_tx40_wrist_and_coulomb_friction(data, tmp_path):
    """Friction at half the speed and more within 2.5 % of the reference; Fc itself is where a line meets standstill.

    It depends on which speeds are cut (joint 1: -7 % with none, as here; -0.4 at 1 % of the peak speed, +6 at 3 %), as
    the reference cut them and no option does any more (standstills count once, slow motion stays), and the
    reference saw 9 s of which these are 5.4: estimates of the two differ by some sqrt(1 - 5.4/9) = 0.63 of our sigma
    (4.2, 2.4, 3.0, 5.5, 12.4 %), by 1.5 to 8 %, however well both are made. A goal of 2.5 % cannot be held to that.
    The reference is least squares without a prior, and so is this.
    """
    folder = data / "staubli_tx40"
    log = folder / "tx40_first_5p4s.npz"
    found = identify(tmp_path / "out", folder / "model.urdf", log, options='prior = "none"' + TX40)
    assert found["parameters"]["base"] == 61
    with (folder / "reference_base_params.csv").open() as file:
        reference = {row[0].split()[0]: float(row[3]) for row in csv.reader(file)}
    own = values(tmp_path / "out")
    fc, fv = (np.array([own[f"{name}{j}"] for j in range(1, 6)]) for name in ("Fc", "Fv"))
    fc_there, fv_there = (np.array([reference[f"{name}{j}"] for j in range(1, 6)]) for name in ("fs", "fv"))
    off = np.abs(fc / fc_there - 1.0)
    assert off.max() < 0.09, "measured -7.0, -2.7, -8.3, -4.1 and 5.8 %"
    for share in (0.5, 0.75):
        v = share * 100.0 * np.array([0.05, 0.05, 0.075, 0.072, 0.056])
        assert np.abs((fc + fv * v) / (fc_there + fv_there * v) - 1.0).max() < 0.025, "what friction does at speed"
    assert total(found, log.name, "filtered") < 5.3, "measured 5.06"


@pytest.mark.slow
def test_tx40_richer_friction_pays(data, tmp_path):
    """The TX40's richer friction pays on other motion."""
    folder = data / "staubli_tx40"
    log = folder / "tx40_first_5p4s.npz"
    options = '[[coupling]]\njoints = [5, 6]\nlabel = "6"'
    arguments = (folder / "model.urdf", f"{log}@0:4", "--validate", f"{log}@4:")
    name = f"{log.name}@4:"
    rich = identify(tmp_path / "rich", *arguments, options=options)
    plain = identify(tmp_path / "plain", *arguments, "--friction", "standard", options=options)
    assert total(rich, name, "filtered") < 0.9 * total(plain, name, "filtered")


@pytest.mark.slow
def test_lwr_one_sine_says_its_limits(data, tmp_path):
    """The LWR with one sine says what it cannot tell."""
    folder = data / "kuka_lwr4plus_iit"
    log = folder / "measurements_1.npz"
    found = identify(tmp_path / "out", folder / "model.urdf", f"{log}@2.5:18", "--validate", f"{log}@18:")
    information = " ".join(found["warnings"])
    assert (
        "one frequency" in information
        and "not identifiable from this motion" in information
        and "no evidence" in information
    )
    assert found["verdict"] == "marginal"
    assert total(found, "measurements_1.npz@18:") < 10.0, "the untouched CAD's error"
    own = values(tmp_path / "out")
    assert all(own[name] >= 0.0 for name in own if name[:2] in ("Ia", "Fv", "Fc") and name[2:].isdigit())


@pytest.mark.slow
def test_lwr_parameters_hold_elsewhere(data, tmp_path):
    """Half of the one closed curve learnt, the other half predicted: plain least squares is worse than the CAD."""
    from calib.dynamics.bodies import standard_parameters
    from calib.identification import prediction
    from calib.identification.physical_consistency import information, solve
    from calib.procedure.dynamic_stage.inputs import gather

    folder = data / "kuka_lwr4plus_iit"
    log = folder / "measurements_1.npz"
    arguments = (folder / "model.urdf", f"{log}@2.5:8.75", "--validate", f"{log}@8.75:15")
    bare = identify(tmp_path / "bare", *arguments, options='prior = "none"')
    identify(tmp_path / "drawn", *arguments, options='prior = "cad"')
    data_alone = information.read(tmp_path / "drawn")
    found = solve.find_possible(data_alone)
    assert (found.margins > 0.0).all()
    inputs = gather(arguments[0], [str(arguments[1])], [str(arguments[3])])
    case = inputs.unseen[0]

    def error(dynamics: prediction.Dynamics) -> float:
        rest = prediction.predict(dynamics, case) - case.target
        return 100.0 * float(np.linalg.norm(rest) / np.linalg.norm(case.target))

    cad = np.zeros(found.dynamics.model.p)
    own = standard_parameters(data_alone.chain)
    cad[: len(own)] = own
    drawn, untouched = (error(one) for one in (found.dynamics, prediction.Dynamics(found.dynamics.model, cad)))
    assert drawn < untouched < total(bare, "measurements_1.npz@8.75:15"), "7.1, 7.4 and 35 % as measured"


@pytest.mark.slow
def test_kr300_needs_prior_on_other_motion(data, tmp_path):
    """Measured in motion: A → B 12.4 % drawn, 18.5 bare with standard friction; B → A 13.4 and 31.5.

    Joint 2 moves over ranges that barely overlap. Of all samples, a quarter at rest, 19.0 and 21.7, 20.2 and 31.6 %;
    with standing rows as any others they were 21.8 and 43.0, 24.4 and 46.0.
    """
    folder = data / "kuka_kr300_tuk"
    robot, train, other = folder / "model.urdf", folder / "traj_A.npz", folder / "traj_B.npz"
    drawn = identify(tmp_path / "out", robot, train, "--validate", other)
    bare = identify(
        tmp_path / "bare", robot, train, "--validate", other, "--friction", "standard", options='prior = "none"'
    )
    assert total(drawn, "traj_B.npz", "moving") < 15.0 < 17.0 < total(bare, "traj_B.npz", "moving")


@pytest.mark.slow
def test_tiago_torso_and_signed_gains(data, tmp_path):
    """Measured 17.1 %: standing rows count as any others here, for counted once they gave 22.7."""
    folder = data / "tiago_laas"
    log = folder / "dynamic.npz"
    found = identify(
        tmp_path / "out", folder / "model.urdf", f"{log}@0:50", "--validate", f"{log}@50:",
        "--base", "base_footprint", "--tip", "arm_7_link",
    )  # fmt: skip
    assert total(found, "dynamic.npz@50:") < 20.0
    with (tmp_path / "out" / "estimate.csv").open() as file:
        units = {row["name"]: row["unit"] for row in csv.DictReader(file)}
    assert units["Fc1"] == "N" and units["Fc2"] == "N m"


LOGS = {
    "franka_panda_inria/traj1_first60pct.npz": (0.0, 6.3, 12.6),
    "staubli_tx40/tx40_first_5p4s.npz": (0.0, 2.0, 5.4),  # its coupled wrist passed for joints 4 and 6 exchanged
    "kuka_kr300_tuk/traj_A.npz": (0.0, 5.0, 10.0),
    "kuka_lwr4plus_iit/measurements_1.npz": (2.5, 12.5, 25.0),
    "tiago_laas/dynamic.npz": (0.0, 40.0, 80.0),
    "ur10e_innopolis/ur-20_02_10-30sec_12harm.npz": (7.0, 21.0, 35.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("log", [pytest.param(one, marks=[pytest.mark.slow] * ("tx40" not in one)) for one in LOGS])
def test_sound_recordings_are_not_accused(data, log):
    """No sign and no order of a sound recording is called wrong."""
    robot, (start, middle, end) = (data / log).parent / "model.urdf", LOGS[log]
    for part in ((start, end), (start, middle), (middle, end)):
        (case,) = gather(robot, [f"{data / log}@{part[0]}:{part[1]}"]).cases
        sizes, names = compare_sizes(case, load(robot)), load(robot).joint_names
        assert signs_of(case, load(robot)) is None
        accusations = {"columns-exchanged", "zero-elsewhere", "torques-late", "clock-off"}
        assert not accusations & {one.code for one in plausibility.findings([sizes], names)}


@pytest.fixture(scope="module")
def panda(data) -> tuple[Chain, Case]:
    """Return the arm and 8.5 s of its recording."""
    robot = data / "franka_panda_inria" / "model.urdf"
    (case,) = gather(robot, [f"{robot.parent / 'traj1_first60pct.npz'}@0:8.5"]).cases
    return load(robot), case


@pytest.mark.slow
@pytest.mark.parametrize(("joint", "way"), [(1, 1.0), (2, 1.0), (2, -1.0), (4, -1.0)])
def test_panda_coupled_joint_is_named(panda, joint, way):
    """A joint of a Panda that counts from the one before it is named."""
    robot, case = panda
    matrix = coupling(7, joint, joint - 1, -way)
    motion = replace(case.motion, **{name: getattr(case.motion, name) @ matrix.T for name in "qva"})
    found = signs_of(replace(case, motion=motion), robot)
    assert found is not None and (found.code, found.joints) == ("axis-coupled", (joint, joint - 1))
    assert found.changes[0].values["way"] == ("+" if way > 0 else "-") and found.factor < 0.4


@pytest.mark.slow
@pytest.mark.parametrize("joint", range(7))
def test_a_reversed_sign_of_a_panda_is_named(panda, joint):
    robot, case = panda
    signs = np.where(np.arange(7) == joint, -1.0, 1.0)
    found = signs_of(replace(case, target=case.target * signs), robot)
    assert found is not None and found.joints == (joint,)
    assert found.before[joint] > 4.0 * found.after[joint], "mean squares"


@pytest.mark.parametrize("clash", ["kuka_kr300_tuk/traj_A.npz", "ur10e_innopolis/ur-20_01_17-p1.npz"])
def test_another_robots_recording_is_refused(data, tmp_path, clash, capsys):
    robot = data / "franka_panda_inria" / "model.urdf"
    assert run("identify", robot, data / clash, "--out", tmp_path / "out") == 2
    assert "7" in capsys.readouterr().err
