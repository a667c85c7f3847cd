"""Files of an identified model: ``robot.toml`` with the geometry, ``dynamics.json`` with the parameters.

``estimate.csv`` has one row per parameter that was estimated, ``covariance.csv`` their covariance (a header, then one
row per parameter, each beginning with its name): base parameters in the order of the model's columns, then richer
friction. ZZ1R stands for the combination that ``dynamics.json`` spells out under ``base``. A richer term that the
evidence switched off has no sigma, and is named under ``switched_off`` in ``metrics.json``; nor has a parameter that a
constraint holds: its zeros in ``covariance.csv`` are the constraint's, and what the other parameters' sigmas rest on.

``unit`` in ``dynamics.json`` and ``metrics.json`` is "N m", or "A of joint 2" where currents had no gains: export,
plan and excite refuse such a model. Gains that were identified stand in ``drive_gains.csv`` (joint, gain [N m per A],
sigma, status) and under ``drive_gains`` in both; state them as ``gains`` to use them again. A gain is identified (in
JSON ``told``), the ``reference`` that the others are relative to (1, without a sigma), or not identified (``not
told``): then gain and sigma are empty, and the joint's torque, friction and motor inertia are in amperes of its own
motor, in every table.

``torques_N.csv``: ``t [s]``, then ``measured_joint1 [N m]`` ... and predicted_ ... of each torque row and the joints
``q_joint1 [rad]`` ..., then sigma_ ... of each torque row, the standard deviation expected of measured - predicted
(1.96 of them hold 95 %), ``extrapolated``, 1 where the motion leaves the training range, nominal_ ... of each torque
row where the robot's geometry was calibrated (the torque of the model that the same recordings give on the nominal
geometry), and, of recordings without a payload, v_ ... a_ ... (the joints' speeds and accelerations, filtered); thinned
to about 100 Hz. ``calib identify``
writes ``torques_1.csv`` alone, of the first validation recording (without one, of the first to learn from); a session
writes one per validation recording.

``metrics.json``: errors by file under ``identification`` (training) and ``validation`` (``evidence`` false: it
repeats the training). Each has ``raw`` (torque as recorded, full rate), ``filtered`` (both sides low-passed to the
identification band f_p), ``moving`` and ``standing`` (raw, samples at which the joint is above or below ``slow``), with
``relative_error_percent`` 100 |tau - predicted| / |tau| in ``total`` and by ``joints`` (in the order of ``rows``) and
``rms`` [N m or N]; ``above_band_percent``: share of the torque above f_p (noise, ripple, elasticity), which no model in
the band explains; ``whiteness`` of the residuals; ``motion_share``: part of the samples at which joints move; unseen
ones have ``interval95``: share of the errors within the 95 % interval that the model states, of all rows and by joint,
its median half width, and how the motion leaves the training range. Then ``parameters`` (standard, base,
essential), ``condition_number`` (raw, and with columns of unit norm), ``friction`` and its ``ladder``, ``elimination``,
``loop``, ``tracking`` by file (or ``tracking_failure``), ``filters`` by file, ``geometry``, ``warnings`` and the
findings behind them, ``noticed`` (code, values; `calib explain CODE`), ``verdict``, its ``reason``, and ``code`` and
``advice`` of the finding that decided it, ``error_density`` of each row (variance of its errors over the independent
rows per second), ``error_growth`` (share of this variance that grows with the variance of the row's torque,
``torque_variance``, on another motion), ``error_bands`` (the density in wider bands, with ``rows_per_second``,
relative to that of the identification, and the ``seconds`` of its recordings), ``choice`` (friction terms with their
ridges, sizes of the prior and its tempering, which ``calib identify --after`` carries on), ``seed``, ``schema`` (3;
files without one are of earlier versions and are read, too). No number: null.

``joint_compliance.csv``, of recordings with encoders on motors and links: joint, compliance (negative: -1 / stiffness,
as in the geometric fit's corrections) with sigma, whether it is identified, and the rms difference of the encoders: as
recorded, without their delay, and what delay and compliance leave.

Figures are in report.html, and with ``--plots png`` (or svg) as files, too: ``plot_torque_N.png`` of every unseen
recording in the order given, of those to learn from where none is unseen (measured, predicted, residual, low-passed to
the identification band), ``plot_errors.png``, ``plot_residuals.png`` (autocorrelation; dashed: white noise),
``plot_significance.png``, and, where the geometry's uncertainty is known, what it adds to sigma; ``plot_friction.png``
(over velocity), in a session that alone: its report has the others. Recordings to learn from are drawn by
``model.plot("torque_N")``, where N counts on after the unseen ones.
"""

import json
from pathlib import Path

import numpy as np

from calib import folders
from calib.config_types import ParsedTable
from calib.dynamics.base import Base, expressions
from calib.dynamics.bodies import bodies_of, with_payload
from calib.dynamics.drives import DriveTerm
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.torque_rows import torque_rows
from calib.errors import RobotError, refuse_option, refused_as
from calib.identification.prediction import Dynamics
from calib.robot import description
from calib.robot.calibrated import ROBOT
from calib.robot.chain import Chain, random_joints
from calib.robot.kinematics import forward
from calib.units import TORQUE, per_ampere, without_gains

MAX_TIP_DISTANCE = 0.05
"""Distance of the tips of two arms of one type, in units of the reach; they agree within a percent (our choice)."""


MODEL = "dynamics.json"
NOTE = "regrouped parameters have base values, all others are zero: torques are right, single parameters may not be"


def read_dynamics(folder: str | Path) -> tuple[Chain, Dynamics]:
    """Return the robot and the identified model stored in `folder`.

    Raises:
        RobotError: if the folder contains no model, or its two files are of different robots or versions.
    """
    folder = Path(folder)
    table = read_table(folder)
    chain = description.read(folder / ROBOT)
    message = f"{folder}/dynamics.json is damaged or of another version ({{}}); identify again"
    with refused_as(RobotError, (KeyError, TypeError, ValueError, IndexError), message):
        return chain, from_table(chain, table)


def read_table(folder: Path) -> ParsedTable:
    """Return the content of ``dynamics.json`` as a table for `from_table`.

    Raises:
        RobotError: if the folder contains no readable model.
    """
    with refused_as(
        RobotError,
        (OSError, UnicodeDecodeError, json.JSONDecodeError),
        f"{folder} contains no identified model (dynamics.json): {{}}; give the folder of an identification",
    ):
        table = json.loads((folder / MODEL).read_text(encoding="utf-8"))
    if not isinstance(table, dict):
        raise RobotError(
            f"{folder}/dynamics.json is damaged or of another version (it contains no table); identify again"
        )
    return table


def refuse_currents(folder: Path, task: str) -> None:
    """Raise an error for a model in amperes (identified from currents without gains) if a task needs torques.

    Args:
        folder: folder of the identification.
        task: name of the task in the message.

    Raises:
        UsageError: for a model whose unit is not N m.
        RobotError: if the folder contains no model.
    """
    unit = read_table(folder).get("unit", TORQUE)
    if unit != TORQUE:
        refuse_option(
            folder,
            f"torques are {without_gains(unit)}; {task} needs N m: state "
            "gains = [...] (N m/A) in the options file, or identify them with [gain_identification] (runs without and "
            "with a load of known mass), and run calib identify again",
        )


def refuse_other_arm(folder: Path, chain: Chain) -> None:
    """Raise an error if `folder` contains the identification of another arm than `chain`.

    Raises:
        UsageError: for another number of joints, or another position of the tip at equal joint values.
        RobotError: if the folder's robot cannot be read.
    """
    identified = description.read(folder / ROBOT)
    if identified.n != chain.n:
        refuse_option(
            folder,
            f"is of a robot with {identified.n} joints ({identified.name}), but {chain.name} has {chain.n}: identify "
            "this robot",
        )
    q = random_joints(chain, 20, 0)
    tips = forward(chain, q)[:, :3, 3]
    identified_tips = forward(identified, q)[:, :3, 3]
    distance = float(np.median(np.linalg.norm(tips - identified_tips, axis=1)))
    reach = float(np.linalg.norm(tips, axis=1).max())
    if distance > MAX_TIP_DISTANCE * reach:
        refuse_option(
            folder,
            f"is of another robot ({identified.name}): its tip is {distance:.3g} m from that of {chain.name} "
            "(median); identify this robot",
        )


def to_table(dynamics: Dynamics, base: Base, unit: str = TORQUE) -> dict[str, object]:
    """Return a model as a table for ``dynamics.json``.

    Args:
        dynamics: the model with its parameter values.
        base: its base parameters.
        unit: unit of its torques.
    """
    model = dynamics.model
    inertial = model.inertial
    payloads = []
    for label, coordinate in zip(model.bodies.labels, model.bodies.coordinates):
        if coordinate < 0:
            payloads.append(label)
    terms = []
    for term, value in zip(model.columns, dynamics.values[inertial:]):
        acts = [[row, [list(pair) for pair in motion]] for row, motion in term.acts]
        settings = [float(setting) if np.isfinite(setting) else "inf" for setting in term.settings]
        term_unit = per_ampere(term.unit, unit)
        terms.append(
            {
                "name": term.name,
                "shape": term.shape,
                "acts": acts,
                "settings": settings,
                "side": term.side,
                "linear": term.linear,
                "value": float(value),
                "unit": term_unit,
            }
        )
    bodies = dict(zip(model.names[:inertial], dynamics.values[:inertial].tolist()))
    base_expressions = dict(zip(base.names, expressions(base)))
    return {
        "robot": ROBOT,
        "kind": model.torque_rows.name,
        "unit": unit,
        "gravity": model.bodies.gravity.tolist(),
        "payloads": payloads,
        "bodies": bodies,
        "terms": terms,
        "base": base_expressions,
        "regrouping": regrouping(base),
        "covariance": folders.COVARIANCE,
        "note": NOTE,
    }


def regrouping(base: Base) -> dict[str, dict[str, float]]:
    """Return for each base parameter its standard parameters and their coefficients, by name."""
    coefficients = {}
    for name, row in zip(base.names, base.transform):
        used = np.flatnonzero(row)
        coefficients[name] = {base.standard[column]: float(row[column]) for column in used}
    return coefficients


def from_table(chain: Chain, table: ParsedTable) -> Dynamics:
    """Return the model of a chain from a table of `to_table`.

    Args:
        chain: the arm.
        table: the content of ``dynamics.json``.

    Raises:
        KeyError, TypeError, ValueError, IndexError: for a damaged table.
    """
    bodies = bodies_of(chain).with_gravity(np.array(table["gravity"], dtype=float))
    for label in table.get("payloads", ()):
        on = chain.n - 1
        placement = np.asarray(chain.tail)
        bodies = with_payload(bodies, placement, label, on=on)
    terms = tuple(_term(entry) for entry in table["terms"])
    model = IdentificationModel(bodies, terms, torque_rows(table.get("kind", "motor")))
    inertial_values = table["bodies"]
    values = [float(inertial_values[name]) for name in bodies.names[: model.inertial]]
    inertial_count = len(values)
    values += [float(entry["value"]) for entry in table["terms"]]
    if len(values) != model.p or len(inertial_values) != inertial_count:
        raise ValueError(f"{len(values)} values for {model.p} parameters")
    return Dynamics(model, np.array(values))


def _term(entry: ParsedTable) -> DriveTerm:
    """Return the drive term stored in an entry of the table."""
    acts = []
    for row, motion in entry["acts"]:
        weights = tuple((int(joint), float(weight)) for joint, weight in motion)
        acts.append((int(row), weights))
    settings = tuple(float(setting) for setting in entry["settings"])
    name = entry["name"]
    shape = entry["shape"]
    side = entry["side"]
    linear = bool(entry["linear"])
    return DriveTerm(name, shape, tuple(acts), settings, side, linear)


def identified_masses(folder: str | Path, chain: Chain) -> np.ndarray:
    """Return the standard parameters (n, 10) of an arm's bodies from an identification's folder, without payloads.

    Their gravity torques are correct on the geometry of the identification, but single parameters need not be
    (`calib.dynamics.base.to_standard`).

    Args:
        folder: folder of the identification.
        chain: the arm.

    Raises:
        UsageError: for an identification of another arm, in amperes, or without bodies.
    """
    folder = Path(folder)
    refuse_currents(folder, "a fit of the compliance")
    refuse_other_arm(folder, chain)
    _, dynamics = read_dynamics(folder)
    bodies = dynamics.model.bodies
    result = np.zeros((chain.n, 10))
    if not dynamics.model.inertial:
        refuse_option(folder, "has identified no bodies, hence no gravity torques; identify with motor or link torques")
    for row, label in enumerate(bodies.labels):
        if label.isdigit():
            result[int(label) - 1] = dynamics.values[10 * row : 10 * row + 10]
    return result
