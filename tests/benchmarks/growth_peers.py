"""The same work as in `growth_work.py` by FIGAROH and by MuJoCo's sysid: python growth_peers.py NAME SIZE.

pip install figaroh 'mujoco[sysid]'. Run with FIGAROH 1.0.2, MuJoCo 4.0.0, Pinocchio 4.1.0.
"""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import growth_work as ours
import numpy as np
import pinocchio_model

ITERATIONS = 5  # of MuJoCo's sysid at most, each of 29 simulations or more


def figaroh_fit(count: int) -> Callable:
    """Return a fit as FIGAROH's `BaseCalibration` does it: its forward kinematics in SciPy's least squares.

    Base and tool placement and the six deviations of each joint, less what its own check drops as not identifiable.
    """
    import pinocchio as pin
    from figaroh.calibration import calibration_tools as tools
    from figaroh.calibration.parameter import BASE_TPL, EE_TPL, FULL_PARAMTPL
    from scipy.optimize import least_squares

    from calib.robot.formats.urdf_write import write_new

    chain = ours.library("ur5")
    block = ours.measured(chain, count)[1]
    model = pin.buildModelFromXML(write_new(chain))
    data = model.createData()
    frames = [*BASE_TPL, *(f"{name}_1" for name in EE_TPL[:3])]
    joints = [f"{axis}_{joint}" for joint in chain.joint_names for axis in FULL_PARAMTPL]
    options = {
        "param_name": [*frames, *joints], "calib_model": "full_params", "start_frame": "universe",
        "end_frame": chain.tip, "NbMarkers": 1, "actJoint_idx": range(1, 7), "measurability": [True] * 3 + [False] * 3,
        "calibration_index": 3, "NbSample": count, "base_to_ref_frame": None,
    }  # fmt: skip
    points = block.position.T.ravel()
    guess = tools.estimate_frames_closed_form(model, data, block.q, points, options)
    start = np.array([guess.get(name, 0.0) for name in options["param_name"]])
    jacobian = tools.measurement_jacobian(model, data, start, block.q[:100], options)
    kept, _ = tools.select_identifiable_parameters(jacobian, options["param_name"], frames)
    start = np.array([guess.get(name, 0.0) for name in kept])
    options["param_name"] = kept

    def residual(x):
        return points - tools.calc_updated_fkm(model, data, x, block.q, options)

    def run():
        found = least_squares(residual, start, method="lm", max_nfev=1000)
        assert 2.0 * found.cost / len(points) < 4 * 5e-5**2

    return run


def regressor(chain, given: np.ndarray) -> Callable:
    """Return what makes FIGAROH's regressor (n N, 10 n) of q, v, a (3, N, n)."""
    from figaroh.tools.regressor import build_regressor_basic

    model = pinocchio_model.model(chain)
    robot, every = SimpleNamespace(model=model, data=model.createData()), {"act_idxv": range(chain.n)}
    return lambda: build_regressor_basic(robot, *given, every)


def figaroh_regressor(count: int) -> Callable:
    chain = ours.library("lwr4plus")
    return regressor(chain, ours.states(chain, count))


def figaroh_base(n: int) -> Callable:
    from figaroh.tools.qrdecomposition import get_baseParams
    from figaroh.tools.regressor import build_regressor_reduced, get_index_eliminate

    chain = ours.arm(n)
    rows = regressor(chain, ours.states(chain, 1000))
    names = dict.fromkeys((f"p{k}" for k in range(10 * n)), 0.0)

    def run():
        whole = rows()
        without, kept = get_index_eliminate(whole, names)
        get_baseParams(build_regressor_reduced(whole, without), kept, names)

    return run


def figaroh_selection(count: int) -> Callable:
    """Return FIGAROH's weights of the candidates: D-optimality as a cone program."""
    import library_arm
    from figaroh.optimal.base_optimal_calibration import SOCPOptimizer

    rows = library_arm.point_jacobian(library_arm.random_poses(count, 0))
    rows /= np.sqrt(np.mean(rows**2, axis=(0, 1)))
    pool = dict(enumerate(rows.transpose(0, 2, 1) @ rows))
    return lambda: SOCPOptimizer(pool, {"NbSample": count}).solve()


def sysid_identify(samples: int) -> Callable:
    """Return MuJoCo's sysid on masses and centres of the seven bodies, from simulated seconds of motion.

    Its ten parameters per body (``InertiaType.Pseudo``) end in "mass and inertia of moving bodies must be larger than
    mjMINVAL" with MuJoCo 4.0.0 as soon as a model with them is compiled.
    """
    from arms import physical
    from mujoco import MjData, MjSpec, mjtObj, mjtSensor, rollout, sysid

    from calib.robot.formats.urdf_write import write_new

    if not hasattr(sysid, "optimize"):  # MuJoCo without what its sysid needs
        raise ModuleNotFoundError("No module named 'mujoco[sysid]'")
    length = min(samples, 1000)
    chain = replace(ours.library("lwr4plus"), inertias=physical(7))
    described = MjSpec.from_string(write_new(chain))
    described.compile()
    spec = MjSpec.from_string(described.to_xml())  # bodies without mass of their own are one with their parents
    spec.option.timestep = 1e-3
    for joint in spec.joints:
        spec.add_actuator(name=joint.name, target=joint.name, trntype=0).set_to_motor()
        spec.add_sensor(name=joint.name, type=mjtSensor.mjSENS_JOINTPOS, objtype=mjtObj.mjOBJ_JOINT, objname=joint.name)
    model = spec.compile()
    _, q, v, _, tau = ours.log(chain, samples)
    sequences = []
    for begin in range(0, samples, length):
        part = slice(begin, begin + length)
        t = np.arange(len(tau[part])) * 1e-3
        start = sysid.create_initial_state(model, q[begin], v[begin], np.zeros(0))
        state, sensor = (x[0] for x in rollout.rollout(model, MjData(model), start, tau[part][:-1]))
        seen = sysid.TimeSeries.from_names(state[:, 0], sensor, model)
        sequences.append(
            sysid.ModelSequences("arm", spec, f"{begin}", start, sysid.TimeSeries(t, tau[part]), seen)
        )  # fmt: skip
    parameters = sysid.ParameterDict()
    for body in spec.bodies[1:]:
        parameters.add(sysid.body_inertia_param(spec.copy(), model, body.name, sysid.InertiaType.MassIpos))
        parameters[f"{body.name}_inertia"].value[0] *= 1.02  # the masses 2 % too large
    residual = sysid.build_residual_fn(models_sequences=sequences)
    return lambda: sysid.optimize(parameters, residual, optimizer="mujoco", max_iters=ITERATIONS, verbose=False)


if __name__ == "__main__":
    ours.main(globals())
