"""What is known of a layer's wavefront before any measurement: covariance of its nodes, exact or sparse (eq. 23, 37).

Metres of optical path throughout.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse.csgraph import connected_components

from srtomo_srtc.atmosphere import METRES_PER_RADIAN, Profile, covariance, structure_function
from srtomo_srtc.raytrace import LayerGrid

Array = NDArray[np.float64]

_NEIGHBOURS = ((0, 1), (0, -1), (1, 0), (-1, 0))  # in pairs of opposites
_OPPOSITE = (1, 0, 3, 2)


def exact_covariance(grid: LayerGrid, profile: Profile, layer: int) -> Array:
    """Von Karman covariance between a layer's nodes (eq. 24-25 with the layer's weight, which eq. 23 lacks).

    Returns:
        (n_nodes, n_nodes) m^2, positive definite.
    """
    down, right = (np.arange(n) * grid.step for n in grid.mask.shape)
    by_offset = covariance(np.hypot(down[:, None], right), profile.r0, profile.outer_scale)
    by_offset *= profile.fractions[layer] * METRES_PER_RADIAN**2
    row, column = np.nonzero(grid.mask)
    return by_offset[np.abs(row[:, None] - row), np.abs(column[:, None] - column)]


def exact_inverse(grid: LayerGrid, profile: Profile, layer: int) -> Array:
    """Inverse of :func:`exact_covariance`, 1/m^2."""
    return cho_solve(cho_factor(exact_covariance(grid, profile, layer)), np.eye(grid.n_nodes))


def laplacian(grid: LayerGrid) -> sparse.csr_array:
    """Discrete Laplacian of eq. 37: the mean of a node's four neighbours less the node itself.

    At an edge the missing neighbour's quarter is folded onto the one opposite, or onto the node itself where that is
    missing too, so that every row sums to zero.

    Returns:
        (n_nodes, n_nodes), without unit.
    """
    rows, columns, weights = _stencils(grid)
    used = weights != 0
    return sparse.coo_array((weights[used], (rows[used], columns[used])), shape=(grid.n_nodes,) * 2).tocsr()


def sparse_inverse(grid: LayerGrid, profile: Profile, layer: int) -> sparse.csr_array:
    """Sparse stand-in for :func:`exact_inverse`, ``L^T diag(1/v) L`` with L of eq. 37.

    Eq. 37 leaves its scale open. Here v is the variance that each row of L phi has in the layer's own turbulence: with
    weights w on nodes at separations rho, ``v = -1/2 sum_ij w_i w_j D(rho_ij)``. That is the diagonal of highest
    likelihood for L, and ``<phi^T L^T diag(1/v) L phi> = n_nodes`` as the exact inverse has it. Away from edges and for
    a large outer scale ``v = 6.884 (1 - 2^(-7/6) - 2^(-4/3)) (step / r0)^(5/3)`` = 1.086 (step / r0)^(5/3) times the
    layer's fraction, rad^2 at 500 nm. Between the outer scale and the step the approximation's spectrum goes with k^-4
    and the true one with k^-11/3; at the largest scales, where edges and outer scale count, it is too small.

    L^T L knows nothing of piston, and no sensor does: one node of every connected part is held, which fixes the piston
    and changes nothing else.
    """
    weights = _stencils(grid)[2]
    ends = np.array([(0, 0), *_NEIGHBOURS])
    apart = grid.step * np.hypot(*np.moveaxis(ends[:, None] - ends, 2, 0))
    D = structure_function(apart, profile.r0, profile.outer_scale)
    v = -0.5 * np.einsum("ni,ij,nj->n", weights, D, weights) * profile.fractions[layer] * METRES_PER_RADIAN**2
    L = laplacian(grid)
    inverse = (L.T @ sparse.diags_array(1 / v) @ L).tolil()
    _, part = connected_components(L, directed=False)
    _, first = np.unique(part, return_index=True)
    inverse[first, first] += 1 / v[first]
    return inverse.tocsr()


def _stencils(grid: LayerGrid) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """The rows of L: node, node, weight, each (n_nodes, 5); the node itself first, then :data:`_NEIGHBOURS`."""
    number = np.pad(grid.numbers, 1, constant_values=-1)
    row, column = np.nonzero(number >= 0)
    neighbour = np.stack([number[row + up, column + right] for up, right in _NEIGHBOURS], axis=1)
    here = neighbour >= 0
    weight = 0.25 * here
    weight += 0.25 * (here & ~here[:, _OPPOSITE])
    own = np.arange(grid.n_nodes)[:, None]
    return (
        np.broadcast_to(own, (grid.n_nodes, 5)),
        np.concatenate([own, np.where(here, neighbour, own)], axis=1),
        np.concatenate([-weight.sum(axis=1, keepdims=True), weight], axis=1),
    )
