"""A planar 3R arm with known derivatives: x = Σ l_i cos(q_1 + ... + q_i), y likewise; parameters l and offsets of q."""

import numpy as np

LENGTHS = np.array([0.5, 0.4, 0.3])
LOWER, UPPER = np.full(3, -2.5), np.full(3, 2.5)


def jacobian(q):
    """(m, 2, 6): columns ∂/∂l_1..3 and ∂/∂(offset of q_1..3), in units of 1 mm and 1 mrad noise-free whitening."""
    sums = np.cumsum(q, axis=1)
    c, s = np.cos(sums), np.sin(sums)
    tail = np.tril(np.ones((3, 3)))  # column k: elements i >= k
    turns = np.stack([-(LENGTHS * s) @ tail, (LENGTHS * c) @ tail], axis=1)
    return np.concatenate([np.stack([c, s], axis=1), turns], axis=2)


def product(q, G):
    """Σ G ∂J/∂q in closed form: ∂sums_i/∂q_k = 1 for i >= k."""
    sums = np.cumsum(q, axis=1)
    c, s = np.cos(sums), np.sin(sums)
    tail = np.tril(np.ones((3, 3)))
    by_sum = -G[:, 0, :3] * s + G[:, 1, :3] * c
    spread = G[:, :, 3:] @ tail.T  # turn_k holds every element i >= k
    by_sum -= LENGTHS * (spread[:, 0] * c + spread[:, 1] * s)
    return by_sum @ tail


def height(q):
    return (LENGTHS * np.sin(np.cumsum(q, axis=1))).sum(1, keepdims=True) - 0.6


def height_gradient(q):
    return ((LENGTHS * np.cos(np.cumsum(q, axis=1))) @ np.tril(np.ones((3, 3))))[:, None]


def tool(q):
    """Rotation (m, 3, 3) and position (m, 3) in a frame whose z is the plane's y."""
    sums = np.cumsum(q, axis=1)
    x, z, a = (LENGTHS * np.cos(sums)).sum(1), (LENGTHS * np.sin(sums)).sum(1), sums[:, 2]
    rotation = np.zeros((len(q), 3, 3))
    rotation[:, 0, 0], rotation[:, 0, 2], rotation[:, 1, 1] = np.cos(a), -np.sin(a), 1
    rotation[:, 2, 0], rotation[:, 2, 2] = np.sin(a), np.cos(a)
    return rotation, np.stack([x, 0.1 + 0 * x, z], axis=1)


def tool_jacobian(q):
    turns = jacobian(q)[:, :, 3:]
    out = np.zeros((len(q), 6, 3))
    out[:, 0], out[:, 2], out[:, 4] = turns[:, 0], turns[:, 1], -1.0  # q turns about −y of this frame
    return out
