"""An identified robot in the forms others read: each read back by Pinocchio, nothing else of the source changed."""

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest

from calib import files
from calib.dynamics import base as bases
from calib.dynamics import pseudo_inertia, rigid_body
from calib.dynamics.idim import from_chain
from calib.errors import RobotError
from calib.identification.model_file import to_table
from calib.identification.prediction import Dynamics
from calib.procedure.export import identified
from calib.procedure.export.delivery import Export, deliver
from calib.procedure.findings import catalogue
from calib.robot import description
from calib.robot.formats import urdf
from calib.robot.formats.urdf_tree import read as read_tree

SOURCE = """<?xml version="1.0"?>
<robot name="arm">
  <!-- mine -->
  <link name="base"/>
  <link name="one"><visual><geometry><mesh filename="package://a/one.stl"/></geometry></visual>
    <inertial><mass value="4"/><origin xyz="0 0.02 0.1" rpy="0.3 0 0"/>
      <inertia ixx="0.08" ixy="0" ixz="0.001" iyy="0.07" iyz="0" izz="0.03"/></inertial>
  </link>
  <link name="cover"><inertial><mass value="0.5"/>
    <inertia ixx="0.002" ixy="0" ixz="0" iyy="0.002" iyz="0" izz="0.002"/></inertial></link>
  <link name="two"/>
  <link name="flange"><inertial><origin xyz="0.1 0 0"/><mass value="3"/>
    <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.03" iyz="0" izz="0.03"/></inertial></link>
  <link name="finger"><inertial><mass value="0.05"/>
    <inertia ixx="1e-5" ixy="0" ixz="0" iyy="1e-5" iyz="0" izz="1e-5"/></inertial></link>
  <joint name="a" type="continuous"><parent link="base"/><child link="one"/><origin xyz="0 0 0.3"/>
    <axis xyz="0 0 1"/><dynamics damping="9"/></joint>
  <joint name="c" type="fixed"><parent link="one"/><child link="cover"/><origin xyz="0 0.1 0" rpy="0 0 1"/></joint>
  <joint name="b" type="AXIS"><parent link="one"/><child link="two"/><origin xyz="0.05 0 0.4" rpy="1.2 0.1 0"/>
    <axis xyz="0.6 0 0.8"/><limit lower="-0.4" upper="0.5" effort="10" velocity="1"/></joint>
  <joint name="f" type="fixed"><parent link="two"/><child link="flange"/><origin xyz="0 0 0.1" rpy="0 0.5 0"/></joint>
  <joint name="g" type="prismatic"><parent link="flange"/><child link="finger"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="0.04" effort="1" velocity="1"/></joint>
  <transmission name="t"><mechanicalReduction>100</mechanicalReduction></transmission>
</robot>
"""


def write_identification(folder: Path, source: str, seed: int = 0, factor: float = 1.2, loaded: bool = False) -> Path:
    """Write what an identification of a robot off its CAD leaves, noise included; geometry moved by a millimetre."""
    rng = np.random.default_rng(seed)
    nominal = urdf.parse(source, tip="flange")
    values = nominal.values + 1e-3 * rng.standard_normal(len(nominal.values))
    chain = nominal.with_values(values)
    model = from_chain(chain, payload=np.asarray(chain.tail) if loaded else None)
    bodies = np.vstack([chain.inertias, 0.1 * chain.inertias[-1:]]) if loaded else chain.inertias
    truth = np.concatenate([factor * bodies.ravel(), np.tile([0.2, 1.5, 2.0, 0.3], chain.n)])
    base = bases.find(model)
    samples = bases.random_samples(model, 200, seed)
    motion = (samples.q, samples.v, samples.a)
    matrix = np.vstack([model.regressor(*motion, carried=on).reshape(-1, model.p) for on in model.load_cases()])
    kept = matrix[:, base.kept]
    torques = matrix @ truth + 0.02 * rng.standard_normal(len(matrix))
    found = np.linalg.lstsq(kept, torques, rcond=None)[0]
    covariance = 4e-4 * np.linalg.inv(kept.T @ kept)
    description.write(folder / "robot.toml", chain, {"provenance": {"nominal": nominal.values.tolist()}})
    rows = zip(base.names, base.units, found, np.sqrt(np.diag(covariance)))
    files.write_table(folder / "estimate.csv", ("name", "unit", "value", "sigma"), rows)
    lines = [[name, *map(float, row)] for name, row in zip(base.names, covariance)]
    files.write_table(folder / "covariance.csv", ("name", *base.names), lines)
    files.write_json(folder / "dynamics.json", to_table(Dynamics(model, base.to_standard(found)), base))
    return folder


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_urdf_mjcf_and_tables_agree(tmp_path, kind):
    """URDF, MJCF and tables hold the same robot."""
    source = SOURCE.replace("AXIS", kind)
    (tmp_path / "source.urdf").write_text(source)
    folder = write_identification(tmp_path / "found", source)
    notes = deliver(Export(tmp_path / "source.urdf", identified=folder), tmp_path / "out")
    assert any("without motor inertias" in note for note in notes)
    given = identified.read(folder)
    check_torques_with_pinocchio(tmp_path / "out" / "robot.urdf", given)
    before, after = read_tree(source, "before"), read_tree((tmp_path / "out" / "robot.urdf").read_text(), "after")
    assert np.array_equal(after.bodies["cover"], before.bodies["cover"]), "links fixed to others keep their CAD"
    assert np.array_equal(after.bodies["finger"], before.bodies["finger"])
    for name in ("one", "two"):
        assert pseudo_inertia.margin(after.bodies[name]) > 0.0
    table = json.loads((tmp_path / "out" / "parameters.json").read_text())
    standard = table["dynamics"]["standard"]
    assert np.shape(standard["covariance"]) == (len(standard["names"]),) * 2
    assert standard["values"][9] == pytest.approx(1.2 * 4.5, rel=0.5), "its own mass turns about a still axis"
    assert table["geometry"]["names"] == list(given.chain.names)
    assert all(margin > 0.0 for margin in table["dynamics"]["consistency"]["margins_m"].values())
    place = standard["names"].index("Ia2")
    with (tmp_path / "out" / "drives.csv").open(newline="") as file:
        drive = [*csv.DictReader(file)][1]
    assert float(drive["armature"]) == pytest.approx(standard["values"][place])
    assert float(drive["armature_sigma"]) == pytest.approx(standard["covariance"][place][place] ** 0.5)
    assert any(note.startswith("exported masses after each joint: ") for note in notes)


def check_torques_with_pinocchio(path: Path, given: identified.IdentifiedRobot) -> None:
    """Compare with a reading of the test's own: `rnea` of the file against W χ of all standard parameters."""
    pin = pytest.importorskip("pinocchio")
    model = pin.buildModelFromUrdf(str(path))
    data = model.createData()
    rng = np.random.default_rng(5)
    q, v, a = rng.uniform(-0.4, 0.4, (3, 10, 2))
    identified = given.found.dynamics
    drives = identified.values[10 * identified.model.bodies.count :].reshape(2, 4)
    wanted = identified.model.regressor(q, v, a) @ identified.values
    sign = np.tanh(v / identified.model.columns[2].settings[0])
    for k in range(10):
        place = np.concatenate([[np.cos(q[k, 0]), np.sin(q[k, 0]), q[k, 1]], np.zeros(model.nq - 3)])
        rest = np.zeros(model.nv - 2)
        tau = pin.rnea(model, data, place, np.concatenate([v[k], rest]), np.concatenate([a[k], rest]))[:2]
        tau = tau + model.damping[:2] * v[k] + model.friction[:2] * sign[k] + drives[:, 0] * a[k] + drives[:, 3]
        assert np.abs(tau - wanted[k]).max() < 1e-9 * max(1.0, np.abs(wanted).max())


@pytest.mark.parametrize(
    ("change", "factor", "code"),
    [
        ("", 30.0, "masses-unlike"),
        ('izz="0.03"/></inertial>', 1.2, "description-inconsistent"),
        ("", 1.2, "payload-not-exported"),
    ],
)
def test_masses_unlike_the_source_are_said(tmp_path, change, factor, code):
    """Masses that are not the description's are said."""
    source = SOURCE.replace("AXIS", "revolute").replace(change, change.replace("0.03", "0.9"))
    found = write_identification(tmp_path, source, factor=factor, loaded=code == "payload-not-exported")
    assert any(catalogue()[code].says.split("{")[0] in line for line in identified.notes_of(identified.read(found)))


def test_estimate_far_from_robots_is_said(tmp_path):
    """The torques of bodies with negative masses."""
    write_identification(tmp_path, SOURCE.replace("AXIS", "revolute"), factor=-1.0)
    line = next(line for line in identified.notes_of(identified.read(tmp_path)) if "nearest" in line)
    assert "limit" in line and "mostly by" in line


def test_all_else_of_the_source_stays(tmp_path):
    source = SOURCE.replace("AXIS", "revolute")
    (tmp_path / "source.urdf").write_text(source)
    folder = write_identification(tmp_path / "found", source)
    deliver(Export(tmp_path / "source.urdf", identified=folder), tmp_path / "out")
    after = (tmp_path / "out" / "robot.urdf").read_text()

    def bare(text: str) -> str:
        text = text.replace('<link name="two"/>', '<link name="two"></link>')
        return re.sub(r"<(origin|mass|inertia|dynamics)\b[^>]*/>|</?inertial>|\s", "", text)

    assert bare(source) == bare(after) and "<!-- mine -->" in after


def test_tesseract_yaml_moves_to_the_export(tmp_path):
    """Tesseract's YAML moves the source to the export."""
    yaml = pytest.importorskip("yaml")
    from scipy.spatial.transform import Rotation

    source = SOURCE.replace("AXIS", "revolute")
    (tmp_path / "source.urdf").write_text(source)
    folder = write_identification(tmp_path / "found", source)
    deliver(Export(tmp_path / "source.urdf", identified=folder), tmp_path / "out")
    table = yaml.safe_load((tmp_path / "out" / "joint_origins.yaml").read_text())["calibration"]["joints"]
    after = read_tree((tmp_path / "out" / "robot.urdf").read_text(), "after")
    assert set(table) == {"a", "b"}
    for name, entry in table.items():
        position = [entry["position"][key] for key in "xyz"]
        turn = Rotation.from_quat([entry["orientation"][key] for key in "xyzw"]).as_matrix()
        assert np.abs(after.joints[name].origin[:3, 3] - position).max() < 1e-12
        assert np.abs(after.joints[name].origin[:3, :3] - turn).max() < 1e-9


def test_too_heavy_cover_gives_way(tmp_path):
    """A cover heavier than the body gives way, and a finger is refused."""
    source = SOURCE.replace("AXIS", "revolute")
    folder = write_identification(tmp_path / "found", source)
    heavy = source.replace('<mass value="3"/>', '<mass value="30"/>')
    (tmp_path / "source.urdf").write_text(heavy)
    notes = deliver(Export(tmp_path / "source.urdf", identified=folder), tmp_path / "out")
    assert any("flange" in note and "mass zero" in note for note in notes)
    assert read_tree((tmp_path / "out" / "robot.urdf").read_text(), "after").bodies["flange"] is None
    (tmp_path / "source.urdf").write_text(source.replace('<mass value="0.05"/>', '<mass value="50"/>'))
    with pytest.raises(RobotError, match="finger"):
        deliver(Export(tmp_path / "source.urdf", identified=folder), tmp_path / "never")
    assert not (tmp_path / "never").exists()


def test_a_robot_without_urdf_gets_a_new_one(tmp_path):
    folder = write_identification(tmp_path / "found", SOURCE.replace("AXIS", "prismatic"))
    deliver(Export(None, identified=folder), tmp_path / "out")
    assert not (tmp_path / "out" / "joint_origins.yaml").exists()
    check_torques_with_pinocchio_by_joint_names(tmp_path / "out" / "robot.urdf")


def check_torques_with_pinocchio_by_joint_names(path: Path) -> None:
    pin = pytest.importorskip("pinocchio")
    assert list(pin.buildModelFromUrdf(str(path)).names)[1:] == ["a", "b"]


def test_mujoco_reads_the_mjcf(tmp_path):
    """MuJoCo computes from the exported MJCF the torques of our inverse dynamics."""
    mujoco = pytest.importorskip("mujoco")
    folder = write_identification(tmp_path / "found", SOURCE.replace("AXIS", "revolute"))
    deliver(Export(None, identified=folder), tmp_path / "out")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "robot.xml"))
    data = mujoco.MjData(model)
    model.dof_damping[:] = 0.0
    model.dof_frictionloss[:] = 0.0

    rng = np.random.default_rng(3)
    q, v, a = rng.uniform(-0.4, 0.4, (3, 5, 2))
    torques = []
    for position, velocity, acceleration in zip(q, v, a):
        data.qpos[:], data.qvel[:], data.qacc[:] = position, velocity, acceleration
        mujoco.mj_inverse(model, data)
        torques.append(data.qfrc_inverse.copy())

    result = identified.read(folder)
    wanted = rigid_body.inverse_dynamics(result.arm, result.bodies.ravel(), q, v, a) + result.drives.values[:, 0] * a
    assert np.abs(np.array(torques) - wanted).max() < 1e-9 * np.abs(wanted).max()
