"""The pseudo-inertia of a body: ten standard parameters as one symmetric matrix, positive definite where possible.

    P = [ Σ   h ]        Σ = ½ tr(I) 1 - I = ∫ x xᵀ dm,    h = ∫ x dm = (MX MY MZ),    m = ∫ dm,
        [ hᵀ  m ]

about the link frame's origin. P ≻ 0 if and only if some density of mass ≥ 0 has these ten parameters (Wensing, Kim &
Slotine 2018, theorem 1): mass above zero, and the triangle inequality of the moments about the centre of mass. The map
is linear and one to one, so the ten parameters of a body are a point of the cone of 4×4 matrices.
"""

import numpy as np

SYMMETRIC = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def from_standard(parameters: np.ndarray) -> np.ndarray:
    """Return the pseudo-inertia P (…, 4, 4) of standard parameters XX XY XZ YY YZ ZZ MX MY MZ M (…, 10)."""
    return np.tensordot(np.asarray(parameters, dtype=float), BASIS, axes=1)


def to_standard(pseudo: np.ndarray) -> np.ndarray:
    """Return the standard parameters (…, 10) of pseudo-inertias P (…, 4, 4), with the inertia I = tr(Σ) 1 - Σ."""
    pseudo = np.asarray(pseudo, dtype=float)
    second = pseudo[..., :3, :3]
    trace = np.trace(second, axis1=-2, axis2=-1)
    parameters = []
    for row, column in SYMMETRIC:
        diagonal = trace if row == column else 0.0
        parameters.append(diagonal - second[..., row, column])
    parameters += [pseudo[..., row, 3] for row in range(4)]
    return np.stack(parameters, axis=-1)


def margin(parameters: np.ndarray) -> float:
    """Return the margin of physical consistency [m].

    The root of the smallest eigenvalue of Σ / mass about the centre of mass.

    This is the standard deviation of the mass in the body's thinnest direction (t / √12 for a plate of thickness t);
    negative for a physically inconsistent inertia; -inf if the mass is not positive.
    """
    pseudo = from_standard(parameters)
    mass = pseudo[3, 3]
    if not mass > 0.0:
        return -np.inf
    centre = pseudo[:3, 3] / mass
    about_centre = pseudo[:3, :3] / mass - np.outer(centre, centre)
    smallest = float(np.linalg.eigvalsh(about_centre)[0])
    return float(np.copysign(np.sqrt(abs(smallest)), smallest))


def divergence(pseudo: np.ndarray, reference: np.ndarray) -> float:
    """Return the entropic divergence tr(P₀⁻¹ P) - log det(P₀⁻¹ P) - 4 of P from P₀ (Lee, Wensing & Park 2020).

    The divergence is zero only at P = P₀, infinite at the boundary, independent of frame and units.
    """
    ratio = np.linalg.solve(reference, pseudo)
    sign, log_det = np.linalg.slogdet(ratio)
    if not sign > 0:
        return np.inf
    return float(np.trace(ratio) - log_det - 4.0)


def ball(mass: float, radius: float, centre: np.ndarray | None = None) -> np.ndarray:
    """Return ten standard parameters about the link frame of a homogeneous ball (mass [kg], radius and centre [m])."""
    if centre is None:
        centre = np.zeros(3)
    centre = np.asarray(centre, dtype=float)
    pseudo = np.empty((4, 4))
    about_centre = radius**2 / 5.0 * np.eye(3)
    pseudo[:3, :3] = mass * (about_centre + np.outer(centre, centre))
    pseudo[:3, 3] = mass * centre
    pseudo[3, :3] = mass * centre
    pseudo[3, 3] = mass
    return to_standard(pseudo)


def rod(mass: float, end: np.ndarray, radius: float) -> np.ndarray:
    """Return the ten parameters of a uniform rod from the origin to `end` [m], as thick as a ball of `radius`."""
    end = np.asarray(end, dtype=float)
    pseudo = from_standard(ball(mass, radius, end / 2.0))
    pseudo[:3, :3] += mass * np.outer(end, end) / 12.0
    return to_standard(pseudo)


def _basis() -> np.ndarray:
    """Return the pseudo-inertia P of each of the ten unit parameters (10, 4, 4)."""
    basis = np.zeros((10, 4, 4))
    for k, (row, column) in enumerate(SYMMETRIC):
        basis[k, row, column] -= 1.0
        if row != column:
            basis[k, column, row] -= 1.0
        else:
            basis[k, :3, :3] += 0.5 * np.eye(3)
    for row in range(3):
        basis[6 + row, row, 3] = 1.0
        basis[6 + row, 3, row] = 1.0
    basis[9, 3, 3] = 1.0
    return basis


def _units() -> np.ndarray:
    """Return an orthonormal basis (10, 4, 4) of the symmetric matrices."""
    row, column = np.triu_indices(4)
    entry = np.where(row == column, 1.0, np.sqrt(0.5))
    units = np.zeros((10, 4, 4))
    units[np.arange(10), row, column] = entry
    units[np.arange(10), column, row] = entry
    return units


BASIS, UNITS = _basis(), _units()


def unknown_bodies(count: int, term_count: int) -> np.ndarray:
    """Return the P of each body as a linear function of all unknowns, (count, 4, 4, 10 count + terms).

    The unknowns are ten coordinates in `UNITS` per body, followed by the drive terms, on which P does not depend.
    """
    bodies = np.einsum("ij,krs->irsjk", np.eye(count), UNITS)
    bodies = bodies.reshape(count, 4, 4, 10 * count)
    terms = np.zeros((count, 4, 4, term_count))
    return np.concatenate([bodies, terms], axis=3)
