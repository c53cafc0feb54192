"""Covariances of wavefronts and slopes, summed over the layers (eq. 14 and 23), in optical path.

Wavefronts are correlated at nodes, and sparse gradient operators turn nodes into slopes, block by block, so that no
covariance of nodes is ever whole. Node pairs go layer by layer, and stars at different distances, shifts and rotations
need no case of their own; or they go through tables (:mod:`srtomo_srtc.lattice`), wherever these are exact, and with
``fast`` also where they interpolate: one table for a pair of sensors, and tables of each layer from a sensor to points
that a science target is seen through (:mod:`srtomo_srtc.layered`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import pairwise

import numba
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from srtomo_srtc.atmosphere import CovarianceTable, Profile
from srtomo_srtc.geometry import Footprints, Lattice, SeenLattice
from srtomo_srtc.gradient import Stencils
from srtomo_srtc.lattice import Baselines, Correlator, PairTable
from srtomo_srtc.layered import WIDEST, LayeredCorrelator, Neighbours
from srtomo_srtc.parallel import Progress, run, silent
from srtomo_srtc.solve import SymmetricTiles

Array = NDArray[np.float64]
Matrix = NDArray[np.floating]

_CHUNK = 2**23  # entries of a block of nodes and slopes that are held at a time
_LEAST = 1e-8  # weight that counts in float32, of the largest: 1e-7 shows in modes that the mirrors hardly make
_TILE = 12  # points across: with fewer, products are slow; with more, a tile's points count in too many sums


@dataclass(frozen=True)
class Sightline:
    """A sensor towards its star: its nodes on the layers, and how they make slopes.

    Attributes:
        nodes: on the profile's layers.
        gradient: (n_slopes, n_nodes) 1/m.
        seen: the same nodes as a lattice; without it, everything goes layer by layer.
        stencils: the gradient on that lattice; wanted with it.
    """

    nodes: Footprints
    gradient: sparse.csr_array
    seen: SeenLattice | None = None
    stencils: Stencils | None = None

    def only(self, layers: slice) -> Sightline:
        """The same on some of the layers."""
        return replace(self, nodes=self.nodes.only(layers), seen=self.seen and self.seen.only(layers))


def _span(values: Sequence[Array]) -> Array:
    """(n_layers,) from the smallest to the largest, of several (n_layers, n_points)."""
    return np.asarray(np.max([v.max(axis=1) for v in values], axis=0) - np.min([v.min(axis=1) for v in values], axis=0))


@dataclass(frozen=True)
class Turbulence:
    """A profile, and its covariance tabulated as far as a set of footprints needs it."""

    fractions: Array
    table: CovarianceTable

    @classmethod
    def covering(cls, profile: Profile, points: Sequence[Footprints]) -> Turbulence:
        """Tabulate up to the largest separation between any two of ``points`` on a layer."""
        reach = float(np.hypot(_span([p.x for p in points]), _span([p.y for p in points])).max())
        return cls(profile.fractions, CovarianceTable.build(profile.r0, profile.outer_scale, reach))


def wavefront_covariance(turbulence: Turbulence, a: Footprints, b: Footprints) -> Array:
    """Covariance between wavefronts at two sets of points, less the constant C(0) that piston removal takes out.

    Returns:
        (n_a, n_b) m^2.
    """
    table = turbulence.table
    out = np.empty((a.x.shape[1], b.x.shape[1]))
    inputs = (a.x, a.y, b.x, b.y, turbulence.fractions, table.values)
    _sum_layers(*(np.ascontiguousarray(values) for values in inputs), 1 / table.step, out)
    return out


def slope_covariance(
    turbulence: Turbulence, sensors: Sequence[Sightline], *, fast: bool = False, threads: int = 1
) -> Array:
    """Covariance of all slopes with each other, Sigma_ss.

    Args:
        fast: see :func:`slope_tiles`.

    Returns:
        (n_slopes, n_slopes) rad^2, float64, exactly symmetric.
    """
    return np.asarray(slope_tiles(turbulence, sensors, fast=fast, threads=threads).dense(), np.float64)


def slope_tiles(
    turbulence: Turbulence,
    sensors: Sequence[Sightline],
    *,
    fast: bool = False,
    threads: int = 1,
    progress: Progress = silent,
) -> SymmetricTiles:
    """As :func:`slope_covariance`, but half of the matrix, ready to be factored.

    Args:
        fast: float32, and tables also for sensors that are rotated against each other: wrong by less than 1e-4 of the
            norm there.
    """
    starts = [0, *np.cumsum([sensor.gradient.shape[0] for sensor in sensors]).tolist()]
    out = SymmetricTiles(starts[-1], np.float32 if fast else np.float64)
    tasks: list[Callable[[], None]] = []
    widest = max(sensor.gradient.shape[0] for sensor in sensors)
    for i, first in enumerate(sensors):
        strips = _strips(first.gradient, 4 * widest)
        for j, second in enumerate(sensors[: i + 1]):
            correlate = _node_correlation(turbulence, first, second, fast)
            tasks += [partial(_write_slopes, out, correlate, strip, starts[i], starts[j]) for strip in strips]
    run(tasks, threads, progress)
    return out


def slope_cross_covariance(
    turbulence: Turbulence, rows: Sequence[Sightline], columns: Sequence[Sightline]
) -> NDArray[np.float32]:
    """Covariance of the slopes of some sightlines with those of others, as :func:`slope_tiles` has it with ``fast``.

    Returns:
        (n_row_slopes, n_column_slopes) rad^2.
    """
    down, right = (np.cumsum([0] + [line.gradient.shape[0] for line in lines]) for lines in (rows, columns))
    out = np.empty((down[-1], right[-1]), np.float32)
    for i, first in enumerate(rows):
        for j, second in enumerate(columns):
            correlate = _node_correlation(turbulence, first, second, True)
            here = out[down[i] : down[i + 1], right[j] : right[j + 1]]
            stretches = list(_stretches(first.gradient.shape[1], second.gradient.shape[0]))
            if len(stretches) == 1:
                here[:] = first.gradient @ correlate(stretches[0])
                continue
            here[:] = 0
            for some in stretches:
                here += first.gradient[:, some] @ correlate(some)
    return out


def slope_wavefront_covariance(turbulence: Turbulence, sensors: Sequence[Sightline], points: Footprints) -> Array:
    """Covariance between all slopes and the wavefront at points, Sigma_s_phi.

    Returns:
        (n_slopes, n_points) rad m.
    """
    return np.concatenate([s.gradient @ wavefront_covariance(turbulence, s.nodes, points) for s in sensors])


@dataclass(frozen=True)
class Share:
    """Wavefront at points, and what it counts in each of several weighted sums.

    Attributes:
        points: on the profile's layers.
        weights: (n_points, n_sums).
    """

    points: Footprints
    weights: sparse.csr_array


def slope_products(
    turbulence: Turbulence,
    sensors: Sequence[Sightline],
    shares: Sequence[Share],
    *,
    fast: bool = False,
    threads: int = 1,
    progress: Progress = silent,
) -> Array:
    """Covariance of weighted sums of the wavefront with all slopes, ``sum over shares of weights^T Sigma_phi_s``.

    Sigma_phi_s exists only for a few neighbouring points and one sensor at a time: few sums have any weight in these,
    and only those cost.

    Args:
        fast: float32, and tables wherever the sensor allows: wrong by less than 1e-5 of the norm.

    Returns:
        (n_sums, n_slopes).
    """
    starts = np.cumsum([0] + [sensor.gradient.shape[0] for sensor in sensors])
    dtype = np.float32 if fast else np.float64
    out = np.zeros((shares[0].weights.shape[1], starts[-1]), dtype)
    widest = WIDEST * min((s.seen.lattice.step for s in sensors if fast and s.seen is not None), default=math.inf)
    tiles = [tile for share in shares for tile in _tiles(share, dtype, widest)]
    groups = [Neighbours.of(tile.points) for tile in tiles]
    most = max(len(tile.sums) for tile in tiles)

    def add(sensor: Sightline, slopes: slice) -> None:
        correlate = _point_correlation(turbulence, sensor, groups, fast)
        mine, products = out[:, slopes], np.empty((most, slopes.stop - slopes.start), dtype)
        for tile, group in zip(tiles, groups, strict=True):
            own = products[: len(tile.sums)]
            np.matmul(tile.weights, correlate(group), out=own)
            _add_rows(mine, tile.sums, own)

    slices = [slice(*pair) for pair in pairwise(starts)]
    run([partial(add, *pair) for pair in zip(sensors, slices)], threads, progress)
    return out


@dataclass(frozen=True)
class _Tile:
    """Neighbouring points of a :class:`Share`.

    Attributes:
        points: on the profile's layers.
        sums: (n_sums,) those in which they count.
        weights: (n_sums, n_points).
    """

    points: Footprints
    sums: NDArray[np.integer]
    weights: Matrix


def _tiles(share: Share, dtype: type[np.floating], widest: float) -> list[_Tile]:
    """A share's points in tiles that are no wider than so many metres."""
    # near each other on the lowest layer
    x, y = share.points.x[0], share.points.y[0]
    side = min(_TILE * np.sqrt(np.ptp(x) * np.ptp(y) / len(x)), widest)
    column, row = (np.floor((values - values.min()) / side).astype(np.int64) for values in (x, y))
    where = row * (column.max() + 1) + column
    order = np.argsort(where, kind="stable")
    bounds = [0, *(np.flatnonzero(np.diff(where[order])) + 1).tolist(), len(order)]
    weights = share.weights[order]
    least = _LEAST * abs(weights.data).max() if dtype is np.float32 else 0.0
    tiles = []
    for first, last in pairwise(bounds):
        own = weights[first:last].tocoo()
        counts = abs(own.data) > least
        sums, rows = np.unique(own.col[counts], return_inverse=True)
        dense = np.zeros((len(sums), last - first), dtype)
        dense[rows, own.row[counts]] = own.data[counts]
        tiles.append(_Tile(share.points.part(order[first:last]), sums, dense))
    return tiles


@numba.njit(cache=True, nogil=True)
def _add_rows(out: Matrix, rows: NDArray[np.integer], values: Matrix) -> None:
    for i in range(len(rows)):
        out[rows[i]] += values[i]


Correlate = Callable[[slice], Matrix]
"""Covariance of a stretch of points with all slopes of one sensor: (n_points, n_slopes) rad m."""


@lru_cache(maxsize=512)
def _baselines(points: Lattice, lattice: Lattice) -> Baselines:
    return Baselines.between(lattice.to_steps(*points.points()), lattice)


def _node_correlation(turbulence: Turbulence, first: Sightline, second: Sightline, fast: bool) -> Correlate:
    """Of the first sensor's nodes with the second sensor's slopes."""
    a, b = first.seen, second.seen
    if a is not None and b is not None and second.stencils is not None and np.array_equal(a.cones, b.cones):
        baselines = _baselines(a.lattice, b.lattice)
        if fast or baselines.divisions == 1:
            table = PairTable.build(baselines, b.cones, b.offsets - a.offsets, turbulence.fractions, turbulence.table)
            return Correlator(table, second.stencils)
    return _layer_by_layer(turbulence, second, first.nodes)


def _point_correlation(
    turbulence: Turbulence, sensor: Sightline, groups: Sequence[Neighbours], fast: bool
) -> Callable[[Neighbours], Matrix]:
    """Of any group of points with the sensor's slopes: (n_points, n_slopes) rad m; with ``fast`` in float32."""
    if fast and sensor.seen is not None:
        return LayeredCorrelator(sensor.seen, sensor.gradient, groups, turbulence.fractions, turbulence.table)
    return lambda group: np.asarray((sensor.gradient @ wavefront_covariance(turbulence, sensor.nodes, group.points)).T)


def _layer_by_layer(turbulence: Turbulence, sensor: Sightline, points: Footprints) -> Correlate:
    def correlate(stretch: slice) -> Matrix:
        some = Footprints(points.x[:, stretch], points.y[:, stretch])
        return np.asarray((sensor.gradient @ wavefront_covariance(turbulence, sensor.nodes, some)).T)

    return correlate


@dataclass(frozen=True)
class _Strip:
    """Neighbouring slopes of a sensor's sub-apertures.

    Attributes:
        nodes: that they are made from.
        parts: of x and of y slopes: the first, and the gradient on these nodes.
    """

    nodes: slice
    parts: list[tuple[int, sparse.csr_array]]


def _strips(gradient: sparse.csr_array, width: int) -> list[_Strip]:
    """All of a sensor's slopes, as :func:`_stretches` of sub-apertures."""
    n_valid = gradient.shape[0] // 2
    strips = []
    for some in _stretches(n_valid, width):
        both = [gradient[some.start + first : some.stop + first] for first in (0, n_valid)]
        used = np.concatenate([part.indices for part in both])
        nodes = slice(int(used.min()), int(used.max()) + 1)
        strips.append(_Strip(nodes, [(some.start, both[0][:, nodes]), (some.start + n_valid, both[1][:, nodes])]))
    return strips


def _write_slopes(out: SymmetricTiles, correlate: Correlate, strip: _Strip, row: int, column: int) -> None:
    """Some of a sensor's slopes with all of another's; the sensors' begin at ``row`` and ``column``."""
    correlated = correlate(strip.nodes)
    for first, gradient in strip.parts:
        out.write(row + first, column, gradient @ correlated)


def _stretches(n: int, width: int) -> Iterator[slice]:
    """0 .. n in stretches of about equal length, short enough for blocks of ``width`` columns."""
    pieces = -(-n * width // _CHUNK)
    return (slice(*pair) for pair in pairwise([n * i // pieces for i in range(pieces + 1)]))


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def _sum_layers(
    ax: Matrix, ay: Matrix, bx: Matrix, by: Matrix, fractions: Matrix, table: Matrix, per_step: float, out: Matrix
) -> None:
    n = bx.shape[1]
    # unsigned: an index that can count from the end costs a test
    index = np.empty(n, np.uint32)
    beyond = np.empty(n, table.dtype)
    for p in range(ax.shape[1]):
        row = out[p]
        row[:] = 0
        for l in range(len(fractions)):
            x, y, fraction = ax[l, p], ay[l, p], fractions[l]
            # apart from the look-ups this loop vectorises: together they take twice as long
            for q in range(n):
                dx = x - bx[l, q]
                dy = y - by[l, q]
                t = np.sqrt(dx * dx + dy * dy) * per_step
                i = np.int32(t)
                index[q] = i
                beyond[q] = t - i
            for q in range(n):
                value = table[index[q]]
                row[q] += fraction * (value + beyond[q] * (table[index[q] + np.uint32(1)] - value))
