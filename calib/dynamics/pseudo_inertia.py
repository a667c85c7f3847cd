"""The pseudo-inertia of a body: its ten standard parameters as one symmetric 4×4 matrix.

    P = [ Σ   h ]        Σ = ½ tr(I) 1 - I = ∫ x xᵀ dm,    h = ∫ x dm = (MX MY MZ),    m = ∫ dm,
        [ hᵀ  m ]

about the link frame's origin. P ≻ 0 if and only if some non-negative mass density has these ten parameters (Wensing,
Kim & Slotine 2018, theorem 1). This is equivalent to a positive mass and the triangle inequality of the moments of
inertia about the centre of mass. The map from ten parameters to P is linear and one to one.
"""

import numpy as np

SYMMETRIC = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def from_standard(parameters: np.ndarray) -> np.ndarray:
    """Return the pseudo-inertia P (…, 4, 4) of standard parameters XX XY XZ YY YZ ZZ MX MY MZ M (…, 10)."""
    return np.tensordot(np.asarray(parameters, dtype=float), BASIS, axes=1)


def to_standard(pseudo: np.ndarray) -> np.ndarray:
    """Return the standard parameters (…, 10) of pseudo-inertias P (…, 4, 4); the inertia is I = tr(Σ) 1 - Σ.

    Σ (3, 3) is the upper left block of P, the second moment of mass.
    """
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
    """Return the margin of physical consistency [m] of ten standard parameters (10,).

    The margin is the square root of the smallest eigenvalue of Σ / mass about the centre of mass: the standard
    deviation of the mass distribution in the body's thinnest direction (t / √12 for a plate of thickness t). It is
    negative for a physically inconsistent inertia, and -inf if the mass is not positive.
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

    The divergence is zero only at P = P₀, infinite where P is singular or inconsistent, and independent of frame and
    units.

    Args:
        pseudo: P (4, 4).
        reference: P₀ (4, 4), positive definite.
    """
    ratio = np.linalg.solve(reference, pseudo)
    sign, log_det = np.linalg.slogdet(ratio)
    if not sign > 0:
        return np.inf
    return float(np.trace(ratio) - log_det - 4.0)


def ball(mass: float, radius: float, centre: np.ndarray | None = None) -> np.ndarray:
    """Return the ten standard parameters of a homogeneous ball about the link frame's origin.

    Args:
        mass: mass [kg].
        radius: radius [m].
        centre: (3,) centre in the link frame [m]; None: the origin.
    """
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
    """Return the ten standard parameters of a uniform rod from the link frame's origin to `end`.

    Args:
        mass: mass [kg].
        end: (3,) end of the rod [m].
        radius: thickness of the rod, as the radius of a ball with equal spread of mass across the rod [m].
    """
    end = np.asarray(end, dtype=float)
    pseudo = from_standard(ball(mass, radius, end / 2.0))
    pseudo[:3, :3] += mass * np.outer(end, end) / 12.0
    return to_standard(pseudo)


def _basis() -> np.ndarray:
    """Return the pseudo-inertias (10, 4, 4) of the ten unit vectors of standard parameters."""
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
    """Return an orthonormal basis (10, 4, 4) of the symmetric 4×4 matrices."""
    row, column = np.triu_indices(4)
    entry = np.where(row == column, 1.0, np.sqrt(0.5))
    units = np.zeros((10, 4, 4))
    units[np.arange(10), row, column] = entry
    units[np.arange(10), column, row] = entry
    return units


BASIS, UNITS = _basis(), _units()


def unknown_bodies(count: int, term_count: int) -> np.ndarray:
    """Return each body's pseudo-inertia as a linear function of all unknowns, (count, 4, 4, 10 · count + term_count).

    The unknowns are ten coordinates per body in the basis `UNITS`, followed by the drive parameters, on which the
    pseudo-inertias do not depend.

    Args:
        count: number of bodies.
        term_count: number of drive parameters.
    """
    bodies = np.einsum("ij,krs->irsjk", np.eye(count), UNITS)
    bodies = bodies.reshape(count, 4, 4, 10 * count)
    terms = np.zeros((count, 4, 4, term_count))
    return np.concatenate([bodies, terms], axis=3)
