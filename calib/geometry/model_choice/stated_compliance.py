"""Compliance of joints that recordings with encoders on motors and links told, as the prior of a geometric fit.

`calib identify` writes it to ``joint_compliance.csv``, in the sign of the fit's corrections. The fit starts from the
stated compliance c_0 ± s_0 and estimates c with the prior ((c - c_0) / s_0)². If the statement is true, c - c_0 has the
variance s_0² - s² under data alone, with s the posterior standard deviation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from calib.data.csv_table import Table, read_table
from calib.data.poses.measurements import PoseMeasurements
from calib.errors import Finding, UsageError, finding, one_of, refuse_option
from calib.folders import COMPLIANCE, JOINT_COMPLIANCE
from calib.geometry.observation import layout
from calib.geometry.weighing import GeometricFit
from calib.records import frozen
from calib.robot.calibrated import BY_TORQUE, Deflection, Term
from calib.robot.chain import Chain

MAX_SIGMAS = 4.0
"""Standard deviations between stated compliance and poses from which on they contradict each other (our choice)."""
BY_GRAVITY = (*BY_TORQUE, "lever")
"""Terms of effects that gravity causes."""
MIN_SHARE = 1e-6
"""Smallest share of a compliance's variance that poses remove, to be compared: below it is rounding."""


@dataclass(frozen=True, eq=False)
class StatedCompliance:
    """Compliance of E joints from another source than the poses.

    Attributes:
        deflection: the compliances [rad/(N m)], with the chain by whose masses the torques are computed.
        sigma: (E,) standard deviations [rad/(N m)].
    """

    deflection: Deflection
    sigma: np.ndarray

    def __post_init__(self) -> None:
        object.__setattr__(self, "sigma", frozen(self.sigma))


def read_compliance(path: str | Path, chain: Chain) -> StatedCompliance:
    """Return the compliance of the revolute joints that a table marks as identified.

    Args:
        path: ``joint_compliance.csv``, or the folder of an identification.
        chain: the arm, with the masses by which torques are computed.

    Raises:
        MeasurementError: the table is missing, or has other columns.
        UsageError: it names a joint that the arm does not have, or identifies none.
    """
    path = Path(path)
    if path.is_dir():
        path = path / JOINT_COMPLIANCE
    table = read_table(path)
    compliance = table.numbers(COMPLIANCE, None)
    sigma = table.numbers("sigma", None)
    terms: list[Term] = []
    rows: list[int] = []
    for row, (name, identified) in enumerate(zip(table.texts("joint"), table.texts("identified"))):
        one_of(name, chain.joint_names, f"{path}: joint", UsageError)
        joint = chain.joint_names.index(name)
        if identified != "yes" or chain.joints[joint].kind != "revolute":
            continue
        _check_row(table, row, compliance, sigma)
        terms.append(Term(chain.names[chain.moving[joint]], "torque", joint))
        rows.append(row)
    if not terms:
        refuse_option(path, "no revolute joint's compliance is identified; fit without it")
    return StatedCompliance(Deflection(tuple(terms), compliance[rows], chain), sigma[rows])


def _check_row(table: Table, row: int, compliance: np.ndarray, sigma: np.ndarray) -> None:
    """Raise MeasurementError for a compliance of an elastic joint that is not a negative number with a positive sigma.

    Args:
        table: the table.
        row: index of its row.
        compliance, sigma: its columns [rad/(N m)].
    """
    if not compliance[row] < 0.0:
        table.fail(f"{compliance[row]:.3g}: expected a negative number, -1 / stiffness", COMPLIANCE, row)
    if not 0.0 < sigma[row] < np.inf:
        table.fail(f"{sigma[row]:.3g}: expected a positive number", "sigma", row)


def check_torques(blocks: Sequence[PoseMeasurements], source: str) -> None:
    """Check that every block has torques for a stated compliance.

    Args:
        blocks: the blocks to fit.
        source: the file that states the compliance.

    Raises:
        UsageError: a block has no torques.
    """
    for block in blocks:
        if block.torque is None:
            refuse_option(
                f"compliance {source}",
                f"{block.file} has no torques for it; describe the robot's masses, take those of an identification "
                "(masses), or measure torques at rest (tau1 ...)",
            )


def contradictions(fit: GeometricFit, rigid: GeometricFit, stated: StatedCompliance) -> list[Finding]:
    """Return a finding on each joint whose compliance by poses differs from the stated one by `MAX_SIGMAS`.

    Where effects of gravity were added to the geometry, they may hide a stated compliance that is too large: a bearing
    that tilts about the axis of a joint turns the arm as the joint does. Compliant bearings only add to the joint's
    compliance, so that the geometry without them must not be stiffer than stated. Where it is softer, either bearings
    give or the stated compliance is too small, which poses cannot distinguish: a note says so.

    Args:
        fit: the chosen model, whose first corrections are those of the stated compliance.
        rigid: the geometry with these corrections alone.
        stated: the compliance that was the prior.
    """
    deviations = [entry for entry in _deviations(fit, stated) if abs(entry.sigmas) > MAX_SIGMAS]
    findings = [entry.finding() for entry in deviations]
    if not all(term.basis in BY_GRAVITY for term in fit.cell.deflection.terms):
        return findings
    joints = {entry.joint for entry in deviations}
    for entry in _deviations(rigid, stated):
        if entry.joint in joints:
            continue
        if entry.sigmas > MAX_SIGMAS:
            findings.append(entry.finding())
        elif entry.sigmas < -MAX_SIGMAS:
            findings.append(entry.softer())
    return findings


@dataclass(frozen=True)
class _Deviation:
    """Compliance of a joint by poses alone, against the stated one.

    Attributes:
        joint: name of the joint.
        compliance, sigma: compliance by the poses alone, with its standard deviation [rad/(N m)].
        stated, stated_sigma: the stated compliance [rad/(N m)].
        sigmas: the difference over its standard deviation; positive where the poses show a stiffer joint.
    """

    joint: str
    compliance: float
    sigma: float
    stated: float
    stated_sigma: float
    sigmas: float

    def finding(self) -> Finding:
        """Return the finding of a contradiction."""
        return finding("compliance-contradicted", **{**asdict(self), "sigmas": abs(self.sigmas)})

    def softer(self) -> Finding:
        """Return the finding of a joint about whose axis the poses show more compliance than stated."""
        times = self.compliance / self.stated
        return finding("compliance-exceeded", **{**asdict(self), "sigmas": abs(self.sigmas)}, times=times)


def _deviations(fit: GeometricFit, stated: StatedCompliance) -> list[_Deviation]:
    """Return the compliance of each joint by poses alone, which follows from the posterior and its prior.

    Args:
        fit: a fit whose first corrections are those of the stated compliance.
        stated: the compliance that was the prior.
    """
    columns = layout(fit.cell).index("deflection").tolist()
    positions = {parameter: number for number, parameter in enumerate(fit.free.tolist())}
    sigmas = np.sqrt(np.diag(fit.estimate.covariance))
    starts = np.asarray(stated.deflection.coefficients)
    changes = np.asarray(fit.cell.deflection.coefficients)[: len(starts)] - starts
    deviations = []
    for number, term in enumerate(stated.deflection.terms):
        position = positions.get(columns[number])
        if position is None:
            continue
        width = stated.sigma[number]
        share = 1.0 - (sigmas[position] / width) ** 2
        if share < MIN_SHARE:
            continue
        deviations.append(
            _Deviation(
                joint=fit.cell.chain.joint_names[term.source],
                compliance=float(starts[number] + changes[number] / share),
                sigma=float(sigmas[position] / np.sqrt(share)),
                stated=float(starts[number]),
                stated_sigma=float(width),
                sigmas=float(changes[number] / (width * np.sqrt(share))),
            )
        )
    return deviations
