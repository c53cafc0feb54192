"""Tile low-rank matrices: R in blocks, zone of commands by zone of sub-apertures, each held as factors of low rank.

As in TLR-MVM (Ltaief et al. 2021; Doucet et al. 2018). A zone is 64 neighbours on the mirror's or the sensor's grid,
along a Hilbert curve: what is far apart on the sky then stands far apart in R, and has few singular values that matter.
A block B (commands by slopes) becomes ``U (U^T B)``, U the leading left singular vectors of ``B S^(1/2)`` with S the
covariance of the zone's own slopes: turbulence, whose slopes are alike within a zone, and photon noise
(:mod:`srtomo_rtc.compression`). That is the best that so many vectors can do for slopes of covariance S. Over all
blocks, those singular values are left out that buy the least error with the most bytes, up to the tolerance. A block
that its factors would not make smaller stays whole. Factors are 16-bit integers, as in kernel int16.

A product forms the V of each zone once its sub-apertures are there, in a fixed order of zones, then U's rows: packets
and threads decide no bit. ``native/lowrank.c`` does it.

LAPACK finds the singular vectors, and its last bits are not the same everywhere: the factors' digest travels with the
kernel's name, and a replay refuses factors that came out otherwise.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from srtomo_core.layout import Layout
from srtomo_core.system import System
from srtomo_rtc import native
from srtomo_rtc.compression import SlopeStatistics
from srtomo_rtc.native import lib
from srtomo_rtc.vmm import Floats, Int16s, huge_zeros, quantise, rows_of, tiled

Array = NDArray[np.float64]
Indices = NDArray[np.uint32]

TOLERANCE = 0.09
"""Error aimed at, over what photon noise leaves in the commands: 16 bits add to it, and must not pass the limit."""

_TILE = 64  # commands of a zone: the rows that the kernel for 16 bits takes at once
_ZONE = 64  # sub-apertures
_INT16_MAX = 32767
_GRID = 1 << 10  # points across the Hilbert curve, more than any sensor or mirror has


def hilbert(x: NDArray[np.integer], y: NDArray[np.integer]) -> NDArray[np.int64]:
    """How far along a Hilbert curve points of a grid from 0 to 1023 stand."""
    x, y = x.astype(np.int64), y.astype(np.int64)
    along = np.zeros(x.shape, np.int64)
    half = _GRID // 2
    while half:
        right, up = (x & half) > 0, (y & half) > 0
        along += half * half * ((3 * right) ^ up)
        mirrored = right & ~up
        x[mirrored], y[mirrored] = _GRID - 1 - x[mirrored], _GRID - 1 - y[mirrored]
        x, y = np.where(up, x, y), np.where(up, y, x)
        half //= 2
    return along


def _neighbours(mask: NDArray[np.bool_]) -> NDArray[np.intp]:
    """The valid places of a grid, numbered in C order, along a Hilbert curve."""
    y, x = np.nonzero(mask)
    return np.argsort(hilbert(x, y), kind="stable")


@dataclass(frozen=True, eq=False)
class _Zone:
    """One zone of sub-apertures, quantised.

    Attributes:
        columns: places of its slopes among the sensor's, x0 y0 x1 y1 ...
        needs: the sensor's first so many sub-apertures hold it.
        V, V_scales: (n_inner, n_columns) and (n_inner,).
        U: of each row tile (n, 64), columns first; or None where the block's own rows stand in V.
        first: (n_tiles + 1,) the first row of V of each row tile.
    """

    columns: Indices
    needs: int
    V: Int16s
    V_scales: Floats
    U: list[Int16s | None]
    first: NDArray[np.int64]

    def applied(self, scales: Floats) -> Array:
        """(rows of all tiles, n_columns), as it is applied: rows in the order of the tiles."""
        rows = []
        for t, U in enumerate(self.U):
            own = slice(self.first[t], self.first[t + 1])
            inner = self.V[own] * self.V_scales[own, None].astype(np.float64)
            rows.append(inner if U is None else U.T.astype(np.float64) @ inner)
        whole: Array = np.concatenate(rows)
        return whole * scales[:, None].astype(np.float64)


class SensorFactors:
    """R of one sensor in factors, in the frame path's memory.

    Attributes:
        scales: (n_rows,) of the rows of U.
        memory: V and U of all zones.
        native: the frame path's; valid as long as this object.
    """

    def __init__(self, zones: list[_Zone], scales: Floats) -> None:
        self._zones = zones
        self.scales = scales
        inner = [-(-len(zone.V) // _TILE) * _TILE for zone in zones]
        ranks = [sum(len(U) for U in zone.U if U is not None) for zone in zones]
        # one piece of memory each, in the order of use
        self._V = huge_zeros((sum(n * len(zone.columns) for n, zone in zip(inner, zones, strict=True)),), np.int16)
        self._U = huge_zeros((sum(ranks), _TILE), np.int16)
        self.memory = self._V, self._U
        self._kept: list[object] = []
        made = (native.Zone * len(zones))()
        scratch = v = u = 0
        for c, zone, n_inner, n_u in zip(made, zones, inner, ranks, strict=True):
            n_columns = len(zone.columns)
            V = self._V[v : v + n_inner * n_columns].reshape(-1, n_columns, _TILE)
            tiled(zone.V, V)
            V_scales = np.ones(n_inner, np.float32)
            V_scales[: len(zone.V)] = zone.V_scales
            blocks = (native.Block * len(zone.U))()
            for block, U, first, last in zip(blocks, zone.U, zone.first[:-1], zone.first[1:], strict=True):
                block.first, block.last, block.whole = int(first), int(last), U is None
                block.U = self._U[u:].ctypes.data
                if U is not None:
                    self._U[u : u + len(U)] = U
                    u += len(U)
            c.columns, c.n_columns, c.needs, c.n_inner = zone.columns.ctypes.data, n_columns, zone.needs, n_inner
            c.V, c.V_scales, c.blocks, c.U_bytes = V.ctypes.data, V_scales.ctypes.data, blocks, n_u * _TILE * 2
            c.scratch = scratch
            scratch += n_columns + n_inner
            v += n_inner * n_columns
            self._kept += [V_scales, blocks]
        self._made = made
        self._scratch = np.zeros(scratch, np.float32)
        self.native = self._of(self._scratch)

    def _of(self, scratch: Floats) -> native.LowRank:
        return native.LowRank(self._made, len(self._zones), len(self.scales) // _TILE, scratch.ctypes.data)

    @property
    def nbytes(self) -> int:
        """Of matrix that a product reads."""
        return int(self._V.nbytes + self._U.nbytes)

    @property
    def n_columns(self) -> int:
        """Slopes of the sensor."""
        return sum(len(zone.columns) for zone in self._zones)

    @property
    def ranks(self) -> NDArray[np.int64]:
        """Of the blocks that are factors."""
        return np.array([len(U) for zone in self._zones for U in zone.U if U is not None], np.int64)

    @property
    def n_blocks(self) -> int:
        """Blocks, whole ones too."""
        return len(self._zones) * len(self.scales) // _TILE

    def accumulate(self, slopes: Floats, sums: Floats) -> None:
        """Add the whole product to ``sums`` (n_rows,), not scaled; ``slopes`` x0 y0 x1 y1 ... Any thread."""
        scratch = np.zeros_like(self._scratch)
        lib.srt_low_rank_multiply(None, self._of(scratch), 0, len(slopes) // 2, slopes.ctypes.data, sums.ctypes.data)

    def applied(self) -> Array:
        """(n_rows, n_slopes_w) as it is applied; rows in the order of the tiles, slopes x0 y0 x1 y1 ..."""
        matrix = np.zeros((len(self.scales), self.n_columns))
        for zone in self._zones:
            matrix[:, zone.columns] = zone.applied(self.scales)
        return matrix

    def digest(self) -> bytes:
        """Of all that decides a bit of a product."""
        found = hashlib.sha256(self.scales.tobytes() + self._V.tobytes() + self._U.tobytes())
        for zone in self._zones:
            found.update(zone.columns.tobytes() + zone.V_scales.tobytes() + zone.first.tobytes())
            found.update(bytes(U is None for U in zone.U))
        return found.digest()


class Factors:
    """R of all sensors in factors. Immutable but for the scratch memory of the one loop that runs it.

    Attributes:
        rows: (n_rows,) which command each row of the factors is of.
        sensors: of each sensor.
    """

    def __init__(self, rows: Indices, sensors: list[SensorFactors], n_commands: int) -> None:
        self.rows = rows
        self.sensors = sensors
        self._n_commands = n_commands
        self.native = (native.LowRank * len(sensors))(*(one.native for one in sensors))

    @property
    def nbytes(self) -> int:
        """Of matrix that a product reads."""
        return sum(one.nbytes for one in self.sensors)

    @property
    def mean_rank(self) -> float:
        """Of the blocks that are factors; 0: none is."""
        ranks = np.concatenate([one.ranks for one in self.sensors])
        return float(ranks.mean()) if len(ranks) else 0.0

    @property
    def whole(self) -> float:
        """Share of the blocks that stayed whole."""
        return 1 - sum(len(one.ranks) for one in self.sensors) / sum(one.n_blocks for one in self.sensors)

    def times(self, slopes: Floats) -> Floats:
        """``R slopes`` (n_slopes,), sensor by sensor as the loop does; a new array (n_rows,). Any thread."""
        total: Floats = np.zeros(len(self.rows), np.float32)
        start = 0
        for one in self.sensors:
            n = one.n_columns
            own = np.ascontiguousarray(slopes[start : start + n].reshape(2, -1).T).ravel()
            sums: Floats = np.zeros_like(total)
            one.accumulate(own, sums)
            total[self.rows] += one.scales * sums
            start += n
        return total

    def applied(self) -> Floats:
        """R (n_commands, n_slopes) as it is applied."""
        found = []
        for one in self.sensors:
            matrix = one.applied()
            placed = np.empty_like(matrix)
            placed[self.rows] = matrix
            m = self._n_commands
            found.append(placed[:m].reshape(m, -1, 2).transpose(0, 2, 1).reshape(m, -1))
        return np.concatenate(found, axis=1).astype(np.float32)

    def digest(self) -> bytes:
        """Of all that decides a bit of a product."""
        return hashlib.sha256(self.rows.tobytes() + b"".join(one.digest() for one in self.sensors)).digest()


def factorise(system: System, layout: Layout, R: NDArray[np.floating], tolerance: float = TOLERANCE) -> Factors:
    """R (n_commands, n_slopes) in factors. Takes seconds for thousands of commands.

    Args:
        tolerance: error left by what is left out, over what photon noise leaves in the commands, both as
            :func:`srtomo_rtc.compression.error_to_noise` has them but without correlations from zone to zone.

    Raises:
        ValueError: R is not finite, or cannot be held in 16 bits.
    """
    if not np.isfinite(R).all():
        raise ValueError("matrix: expected finite elements")
    order = np.concatenate(
        [start + _neighbours(mirror.mask) for start, mirror in zip(layout.command_start, layout.mirrors, strict=False)]
    )
    n_rows = rows_of(layout.n_commands)
    rows = np.concatenate([order, np.arange(len(order), n_rows)]).astype(np.uint32)
    padded = np.zeros((n_rows, layout.n_slopes))
    padded[: len(order)] = R[order]
    statistics = SlopeStatistics(system, layout)
    noise = 0.0
    sensors = []
    for w, sensor in enumerate(layout.sensors):
        own = padded[:, layout.slopes_of(w)].reshape(n_rows, 2, -1).transpose(0, 2, 1)
        noise += float(np.sum(own**2 @ np.ones(2) @ statistics.photons(w)))
        blocks = []
        places = _neighbours(sensor.mask)
        zones = [np.sort(zone) for zone in np.array_split(places, -(-len(places) // _ZONE))]
        for zone in sorted(zones, key=lambda zone: int(zone[-1])):
            X = own[:, zone].reshape(-1, _TILE, 2 * len(zone))
            weighted = X @ np.linalg.cholesky(statistics.covariance(w, zone))
            powers, vectors = np.linalg.eigh(weighted @ weighted.transpose(0, 2, 1))
            blocks.append(_Decomposed(zone, X, np.maximum(powers[:, ::-1], 0), vectors[:, :, ::-1].astype(np.float32)))
        sensors.append(blocks)
    price = _price([block for blocks in sensors for block in blocks], tolerance**2 * noise)
    return Factors(rows, [_quantised(blocks, price) for blocks in sensors], layout.n_commands)


@dataclass(frozen=True, eq=False)
class _Decomposed:
    """A zone of sub-apertures: X (n_tiles, 64, c); of each tile squared singular values, largest first, and vectors."""

    zone: NDArray[np.intp]
    X: Array
    powers: Array
    vectors: Floats

    def ranks(self, price: float) -> NDArray[np.int64]:
        """Of each tile, so that each value left out is less than ``price`` a number saved; -1: it stays whole."""
        n_columns = self.X.shape[2]
        ranks = np.count_nonzero(self.powers > price * (_TILE + n_columns), axis=1)
        return np.where(ranks * (_TILE + n_columns) < _TILE * n_columns, ranks, -1)


def _price(blocks: list[_Decomposed], budget: float) -> float:
    """The largest price of a number, in squared error, at which all that is left out stays in the budget."""
    below = [
        np.concatenate([np.cumsum(b.powers[:, ::-1], axis=1)[:, ::-1], np.zeros((len(b.X), 1))], 1) for b in blocks
    ]

    def left_out(price: float) -> float:
        total = 0.0
        for block, sums in zip(blocks, below, strict=True):
            ranks = block.ranks(price)
            total += float(sums[np.arange(len(ranks)), ranks][ranks >= 0].sum())
        return total

    low, high = -120.0, math.log(max(float(b.powers.max()) for b in blocks) + 1e-300)
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (low, middle) if left_out(math.exp(middle)) > budget else (middle, high)
    return math.exp(low)


def _quantised(blocks: list[_Decomposed], price: float) -> SensorFactors:
    chosen = [
        [U[:, :rank] if rank >= 0 else None for U, rank in zip(block.vectors, block.ranks(price), strict=True)]
        for block in blocks
    ]
    n_tiles = len(blocks[0].X)
    largest = np.zeros((n_tiles, _TILE))
    for each in chosen:
        for t, U in enumerate(each):
            if U is not None and U.size:
                largest[t] = np.maximum(largest[t], np.abs(U).max(axis=1))
    scales = np.where(largest > 0, largest / _INT16_MAX, 1.0).astype(np.float32)
    zones = []
    for block, each in zip(blocks, chosen, strict=True):
        V, V_scales, integers = [], [], []
        for t, U in enumerate(each):
            X = block.X[t]
            steps, size = quantise(X if U is None else U.T.astype(np.float64) @ X)
            V.append(steps)
            # what stays whole goes straight to sums that are scaled with U's rows
            V_scales.append(size / scales[t] if U is None else size)
            integers.append(None if U is None else np.rint(U / scales[t][:, None]).T.astype(np.int16))
        first = np.concatenate([[0], np.cumsum([len(rows) for rows in V])])
        columns = np.stack([2 * block.zone, 2 * block.zone + 1], axis=1).ravel().astype(np.uint32)
        zones.append(
            _Zone(columns, int(block.zone[-1]) + 1, np.concatenate(V), np.concatenate(V_scales), integers, first)
        )
    return SensorFactors(zones, scales.ravel())
