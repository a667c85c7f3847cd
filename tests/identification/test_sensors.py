"""Joint torque sensors through ``calib identify``: Models 1 to 3, loaded and unloaded runs stacked."""

import csv
import json
from pathlib import Path

import numpy as np
import planted_motion as planted
import pytest
from without_figures import run

from calib.dynamics import drives
from calib.dynamics.bodies import bodies_of, with_payload
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.torque_rows import torque_rows

SIDED = {
    "Ia": (0.5, 0.4, 0.1), "Fvl": (1.2, 0.5, 0.2), "Fcl": (1.0, 1.5, 0.3), "offl": (0.1, -0.1, 0.05),
    "Fvm": (0.8, 1.0, 0.4), "Fcm": (2.0, 1.0, 0.5), "offm": (0.2, -0.1, 0.05),
}  # fmt: skip
NOISE = {"tau_l": 0.05, "tau_m": 0.2}


def model(kind: str) -> IdentificationModel:
    bodies = with_payload(bodies_of(planted.arm()), np.asarray(planted.arm().tail), "tool", on=planted.N - 1)
    return IdentificationModel(bodies, drives.standard([" ".join(SIDED)] * planted.N), torque_rows(kind))


def truth() -> dict[str, float]:
    values = [*planted.INERTIAS.ravel(), *planted.PAYLOAD]
    values += [SIDED[name][joint] for joint in range(planted.N) for name in SIDED]
    return dict(zip(model("both").names, values))


def log(folder: Path, name: str, seed: int, loaded: bool, columns: tuple[str, str] = ("tau_l", "tau_m")) -> str:
    t, q, v, a = planted.motion(seed)
    carried = ("tool",) if loaded else ()
    both = model("both").regressor(q, v, a, carried=carried) @ np.array(list(truth().values()))
    rng = np.random.default_rng(seed)
    torques = {"tau_l": both[:, :3], "tau_m": both[:, 3:]}
    header, parts = ["t", "q1", "q2", "q3"], [t, q]
    for column, ours in zip(columns, NOISE):
        header += [f"{column}{j}" for j in (1, 2, 3)] if column else []
        parts += [torques[ours] + NOISE[ours] * rng.normal(size=q.shape)] if column else []
    np.savetxt(folder / name, np.column_stack(parts), delimiter=",", header=",".join(header), comments="", fmt="%.8g")
    return str(folder / name)


def identify(robot: Path, folder: Path, rows: str, *logs: str) -> tuple[int, Path]:
    (folder / "options.toml").write_text(
        f'rows = "{rows}"\n[filter]\ncutoff = 30.0\nband = 8.0\n[payload.tool]\n'
        + "".join(f'[files."{Path(name).name}"]\npayload = ["tool"]\n' for name in logs if "loaded" in name)
    )
    options, out = folder / "options.toml", folder / rows
    return run("identify", robot, *logs, "--options", options, "--out", out), out


@pytest.mark.parametrize(
    "rows, count",
    [
        pytest.param("link", 34, marks=pytest.mark.slow),
        pytest.param("both", 46, marks=pytest.mark.slow),
        pytest.param("drive", 12, marks=pytest.mark.slow),
    ],
)
def test_models_1_to_3_recover_the_truth(robot, tmp_path, capsys, rows, count):
    """Model 2 has as many base parameters as Models 1 and 3 together, and all lie where their sigmas say."""
    columns = ("tau_sensor", "tau") if rows == "both" else ("tau_l", "tau_m")  # motor torques may be called tau
    logs = log(tmp_path, "empty.csv", 0, False, columns), log(tmp_path, "loaded.csv", 1, True, columns)
    code, out = identify(robot, tmp_path, rows, *logs)
    metrics = json.loads((out / "metrics.json").read_text())
    assert code == 0 and metrics["parameters"]["base"] == count
    assert metrics["rows"] == (["l1", "l2", "l3", "m1", "m2", "m3"] if rows == "both" else ["1", "2", "3"])
    table, known = list(csv.DictReader((out / "estimate.csv").open())), truth()
    own = [row for row in table if row["name"] in known and row["name"] == row["expression"]]
    away = np.array([(float(row["value"]) - known[row["name"]]) / float(row["sigma"]) for row in own])
    assert len(own) > 8 and np.sqrt(np.mean(away**2)) < 1.7
    if rows != "drive":
        mass = next(row for row in table if row["name"] == "Mtool")
        assert abs(float(mass["value"]) - 2.0) < 4 * float(mass["sigma"]) < 0.1
    assert f"{count} base" in capsys.readouterr().out


@pytest.mark.parametrize(
    "rows, columns, message",
    [
        ("both", ("tau_l", ""), "need two torques"),
        ("drive", ("", "tau_m"), "need two torques"),
        ("link", ("", "tau_m"), "torques of sensors behind the gear"),
        ("both", ("", "tau"), "behind the gear"),
    ],
)
def test_a_missing_torque_is_named(robot, tmp_path, capsys, rows, columns, message):
    code, out = identify(robot, tmp_path, rows, log(tmp_path, "empty.csv", 0, False, columns))
    assert code == 2 and message in " ".join(capsys.readouterr().err.split()) and not out.exists()
