"""A set of chosen candidate poses, with the determinant of its information matrix M updated at each change.

With C = M⁻¹ and the Jacobian z (rows, p) of one pose, the matrix determinant lemma and Woodbury's identity give

    det(M ± zᵀz) = det M · det(S),   S = I ± z C zᵀ,   (M ± zᵀz)⁻¹ = C ∓ C zᵀ S⁻¹ z C ,

so that all candidates are compared by small blocks (rows, rows). The scores d_i = tr(z_i C z_iᵀ) of all candidates are
updated by one product with a matrix of few rows.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from .scaled_jacobians import log_det

# multiple of the identity matrix (the mean information of one candidate) added to every design, so that sets without
# full rank can be compared (our choice); values reported to the user do not contain it
RIDGE = 1e-6


@dataclass(frozen=True)
class Pool:
    """Candidates to choose from, in the scaled coordinates of `calib.poses.scaled_jacobians.Candidates`.

    The fields are the Jacobians z (N, rows, p) of N candidates and the information (p, p) of the poses measured before.
    """

    z: np.ndarray
    known: np.ndarray

    @cached_property
    def columns(self) -> np.ndarray:
        """Jacobians as (p, rows · N), candidates last: products with all of them are then sums along the memory."""
        columns = np.ascontiguousarray(self.z.transpose(2, 1, 0))
        return columns.reshape(len(columns), -1)

    @cached_property
    def coarse_columns(self) -> np.ndarray:
        """`columns` in single precision."""
        return self.columns.astype(np.float32)

    @cached_property
    def sizes(self) -> np.ndarray:
        """Norms (N,) of the Jacobians of all candidates."""
        return np.linalg.norm(self.z, axis=(1, 2))

    def squares(self, factor: np.ndarray) -> np.ndarray:
        """Return the sums of squares (N,) of z Fᵀ of all candidates, for a matrix F (k, p)."""
        product = factor @ self.columns
        spread = product.reshape(-1, len(self.z))
        return np.einsum("ij,ij->j", spread, spread)

    def coarse_squares(self, factors: np.ndarray) -> np.ndarray:
        """Return the sums of squares (K, N) as of `squares`, for matrices F (K, k, p), in single precision."""
        count, _, p = factors.shape
        flat = factors.reshape(-1, p).astype(np.float32)
        product = flat @ self.coarse_columns
        spread = product.reshape(count, -1, len(self.z))
        return np.einsum("kij,kij->kj", spread, spread)


@dataclass(frozen=True)
class Design:
    """A set of chosen candidates, with its information matrix and log det.

    Attributes:
        members: indices of the chosen candidates, in the order of choosing.
        inverse: (p, p) C = (known + ridge + Σ zᵀz)⁻¹.
        scores: (N,) tr(z_i C z_iᵀ) of all candidates.
        logdet: log det of C⁻¹.
        taken: (N,) True for members.
    """

    members: tuple[int, ...]
    inverse: np.ndarray
    scores: np.ndarray
    logdet: float
    taken: np.ndarray = field(repr=False)


def design_of(pool: Pool, members: tuple[int, ...]) -> Design:
    """Return the design of the given members, computed from scratch to remove the rounding errors of many updates.

    Args:
        pool: the candidates and the information of the poses measured before.
        members: indices of the chosen candidates in the pool.
    """
    p = pool.z.shape[2]
    count = len(pool.z)
    rows = pool.z[list(members)].reshape(-1, p)
    ridge = RIDGE * np.eye(p)
    matrix = pool.known + ridge + rows.T @ rows
    root = np.linalg.inv(np.linalg.cholesky(matrix))
    is_member = np.zeros(count, dtype=bool)
    is_member[list(members)] = True
    logdet = float(log_det(matrix))
    return Design(members, root.T @ root, pool.squares(root), logdet, is_member)


def with_added(pool: Pool, design: Design, i: int) -> Design:
    """Return the design after adding the candidate with index i, which must not be a member.

    Args:
        pool: the candidates from which the design is chosen.
        design: the design, which is not changed.
        i: index of the candidate in the pool.
    """
    return _changed(pool, design, i, 1.0)


def with_removed(pool: Pool, design: Design, i: int) -> Design:
    """Return the design after removing the candidate with index i, which must be a member.

    Args:
        pool: the candidates from which the design is chosen.
        design: the design, which is not changed.
        i: index of the candidate in the pool.
    """
    return _changed(pool, design, i, -1.0)


def best_addition(pool: Pool, design: Design, above: float = -np.inf, first: int = 8) -> tuple[int, float]:
    """Return the candidate outside the design that raises log det most, and that gain of log det.

    The search is exact, though only few candidates are evaluated. With B (r, r) = z C zᵀ of a candidate, by the
    arithmetic-geometric mean det(I + B) ≤ (1 + tr(B)/r)^r for r rows; a candidate whose score by this bound cannot
    exceed the best gain so far (or `above`) is skipped.

    Args:
        pool: the N candidates; an index refers to them.
        design: the present design.
        above: gains of log det up to this value are ignored.
        first: number of candidates evaluated before any is skipped.

    Returns:
        (index, gain); (−1, above) where no candidate gains more than `above`.
    """
    rows = pool.z.shape[1]
    scores = np.where(design.taken, -np.inf, design.scores)
    best = -1
    gain = above
    min_score = rows * np.expm1(max(above, 0.0) / rows)
    while True:
        candidates = np.flatnonzero(scores > min_score)
        if not len(candidates):
            return best, gain
        order = np.argsort(-scores[candidates], kind="stable")
        batch = candidates[order[:first]]
        gains = gains_of(pool, design, batch, 1.0)
        if gains.max() > gain:
            best = int(batch[gains.argmax()])
            gain = float(gains.max())
        scores[batch] = -np.inf
        min_score = rows * np.expm1(max(gain, 0.0) / rows)
        first *= 4


def best_removal(pool: Pool, design: Design) -> tuple[int, float]:
    """Return the index of the member whose removal reduces log det least, and the (negative) change of log det.

    Args:
        pool: the candidates; the index refers to them.
        design: the design, which is not changed.
    """
    members = np.array(design.members)
    gains = gains_of(pool, design, members, -1.0)
    return int(members[gains.argmax()]), float(gains.max())


def gains_of(pool: Pool, design: Design, candidates: np.ndarray, sign: float) -> np.ndarray:
    """Return the changes of log det (K,) by adding (`sign` 1) or removing (`sign` −1) each of K candidates alone.

    The change is log det(I ± z_i C z_iᵀ), with the candidate's Jacobian z_i (rows, p) and C = M⁻¹ of the design.

    Args:
        pool: the candidates.
        design: the design to change.
        candidates: (K,) indices into the pool.
        sign: 1 or −1.
    """
    z = pool.z[candidates]
    transposed = z.transpose(0, 2, 1)
    blocks = (z @ design.inverse) @ transposed
    identity = np.eye(z.shape[1])
    return log_det(identity + sign * blocks)


def _changed(pool: Pool, design: Design, i: int, sign: float) -> Design:
    z = pool.z[i]
    rows = len(z)
    zc = z @ design.inverse
    block = np.eye(rows) + sign * (zc @ z.T)
    root = np.linalg.cholesky((block + block.T) / 2)
    half = np.linalg.solve(root, zc)
    is_member = design.taken.copy()
    is_member[i] = sign > 0
    if sign > 0:
        members = (*design.members, i)
    else:
        members = tuple(member for member in design.members if member != i)
    scores = np.maximum(design.scores - sign * pool.squares(half), 0.0)
    half_logdet = float(np.log(np.diag(root)).sum())
    logdet = design.logdet + 2.0 * half_logdet
    inverse = design.inverse - sign * (half.T @ half)
    return Design(members, inverse, scores, logdet, is_member)
