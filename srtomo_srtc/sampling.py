"""Fewer slopes that tell nearly as much: what a fit of covariances is made from.

Its cost grows with the cube of their number. All sub-apertures when these are few enough. Otherwise sub-apertures are
averaged in square blocks, which see the outer scale and the altitudes, and in a part of the pupil, the same for every
sensor, they stay single: small scales and noise are told apart there. A block is a sub-aperture itself, only larger,
and is modelled as one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from srtomo_core.layout import Layout, SensorLayout
from srtomo_core.system import System
from srtomo_srtc.atmosphere import Profile
from srtomo_srtc.covariance import Sightline
from srtomo_srtc.geometry import SeenLattice, footprints
from srtomo_srtc.gradient import gradient_operator
from srtomo_srtc.model import blind_modes

Array = NDArray[np.float64]

CELLS = 8
"""Node cells across a sub-aperture, and across a block. With two, the paper's, 4 % of the slopes' variance is missing
from the model, up to 15 % in the middle eigen-bands; what coarse blocks lack is taken for noise."""

FEWEST = 40
"""Slopes of a sensor that there is always a sampling with."""

_IN_BLOCKS = 0.6  # of the slopes, at most
_CENTRE = 0.55  # of the pupil's radius: of the part with single sub-apertures


@dataclass(frozen=True)
class Part:
    """Sub-apertures of one size of one sensor.

    Attributes:
        sensor: index.
        place: where they are.
        cells: of nodes across one.
    """

    sensor: int
    place: SensorLayout
    cells: int


@dataclass(frozen=True, eq=False)
class Sampling:
    """Some or all of an instrument's slopes, or means of neighbouring ones.

    Attributes:
        parts: in the order of the reduced slopes, all x then all y of each.
        reduction: (n_reduced, n_slopes) T: means of measured slopes.
        blind: (n_reduced, n_modes) orthonormal; what is left there of the modes that stars are blind to.
        sensors: (n_reduced,) whose each is.
    """

    parts: tuple[Part, ...]
    reduction: sparse.csr_array
    blind: Array
    sensors: NDArray[np.intp]

    @classmethod
    def of(cls, system: System, layout: Layout, limit: int, cells: int = CELLS) -> Sampling:
        """At most about ``limit`` slopes, of sensors with more than one sub-aperture.

        The tip-tilt of a one-lens sensor has the telescope's shake in it, and its noise is lost under the atmosphere's.

        Raises:
            ValueError: there is no sensor with more than one sub-aperture, or ``limit`` is too small for some blocks of
                each; :data:`FEWEST` a sensor are enough.
        """
        many = [w for w, place in enumerate(layout.sensors) if place.n_valid > 1]
        if not many:
            raise ValueError(f"{system.name}: expected a sensor with more than one sub-aperture")
        found = [pair for w in many for pair in _parts(system, layout.sensors[w], w, limit / len(many) / 2, cells)]
        # large ones last: their nodes are among those of the small ones, which saves interpolation
        found.sort(key=lambda pair: pair[0].place.size)
        parts = [part for part, _ in found]
        reduction = sparse.csr_array(sparse.vstack([_wide(layout, part, mean) for part, mean in found]))
        left, size, _ = np.linalg.svd(reduction @ blind_modes(system, layout), full_matrices=False)
        blind = left[:, size > 1e-6 * size.max(initial=0.0)]
        return cls(
            tuple(parts), reduction, blind, np.repeat([p.sensor for p in parts], [p.place.n_slopes for p in parts])
        )

    def __len__(self) -> int:
        return int(self.reduction.shape[0])

    def sightlines(self, system: System, profile: Profile, coarser: int = 1) -> list[Sightline]:
        """Each part's nodes on the profile's layers, ``coarser`` times fewer a side, with its gradient operator."""
        lines = []
        for part in self.parts:
            star = system.star_of(system.sensors[part.sensor])
            operator = gradient_operator(system.telescope, part.place, cells=max(1, part.cells // coarser))
            aim = star.position, system.los_range(star), profile.heights
            lines.append(
                Sightline(
                    footprints(operator.x, operator.y, *aim),
                    operator.matrix,
                    SeenLattice.towards(operator.lattice, *aim),
                    operator.stencils,
                )
            )
        return lines

    def reduced(self, matrix: NDArray[np.floating] | sparse.csr_array) -> Array:
        """``T matrix T^T`` of a matrix (n_slopes, n_slopes)."""
        half = self.reduction @ matrix
        product = (self.reduction @ half.T).T
        return np.asarray(product.toarray() if sparse.issparse(product) else product, np.float64)


def _wide(layout: Layout, part: Part, mean: sparse.csr_array) -> sparse.csr_array:
    """(2 n, n_slopes): the same means of a sensor's x and y slopes, out of all sensors'."""
    own = layout.slopes_of(part.sensor)
    both = sparse.csr_array(sparse.kron(np.eye(2), mean))
    before, after = (sparse.csr_array((both.shape[0], n)) for n in (own.start, layout.n_slopes - own.stop))
    return sparse.csr_array(sparse.hstack([before, both, after]))


def _parts(
    system: System, place: SensorLayout, sensor: int, limit: float, cells: int
) -> list[tuple[Part, sparse.csr_array]]:
    """With, for each, the (n, n_valid) means that make it; at most about ``limit`` sub-apertures in all."""
    if place.n_valid <= limit:
        return [(Part(sensor, place, cells), sparse.csr_array(sparse.eye_array(place.n_valid)))]
    across = 2
    # blocks lie about the centre of the pupil, as their sensor's grid does
    while len(place.mask) % across % 2 or len(_blocks(place, across)) > max(0.0, _IN_BLOCKS * limit):
        across += 1
    blocks = _blocks(place, across)
    if not blocks:
        least = FEWEST * sum(other.subapertures > 1 for other in system.sensors)
        raise ValueError(f"{system.name}: too few slopes to work with: expected at least {least}")
    centres = np.array([place.local[block].mean(axis=0) for block in blocks])
    aim = _CENTRE * system.telescope.diameter / 2
    nearest = np.argsort(np.hypot(centres[:, 0] - aim, centres[:, 1]), kind="stable")
    n_single = math.ceil((limit - len(blocks)) / (across**2 - 1))
    patch = np.concatenate([blocks[i] for i in nearest[:n_single]])
    close = np.argsort(np.hypot(place.local[patch, 0] - aim, place.local[patch, 1]), kind="stable")
    single = np.sort(patch[close[: int(limit) - (len(blocks) - n_single)]])
    whole = [blocks[i] for i in sorted(nearest[n_single:])]
    picked = sparse.csr_array((np.ones(len(single)), (np.arange(len(single)), single)), (len(single), place.n_valid))
    out = [(Part(sensor, _subset(place, single), cells), picked)]
    if whole:
        light = [place.illumination[block] / place.illumination[block].sum() for block in whole]
        rows = np.repeat(np.arange(len(whole)), across**2)
        means = sparse.csr_array((np.concatenate(light), (rows, np.concatenate(whole))), (len(whole), place.n_valid))
        out.append((Part(sensor, _coarse(place, whole, across), cells), means))
    return out


def _blocks(place: SensorLayout, across: int) -> list[NDArray[np.intp]]:
    """The sub-apertures of each block of which all are valid."""
    n, edge = len(place.mask) // across, len(place.mask) % across // 2
    number = np.full(place.mask.shape, -1)
    number[place.mask] = np.arange(place.n_valid)
    found = []
    for row in edge + across * np.arange(n):
        for column in edge + across * np.arange(n):
            block = number[row : row + across, column : column + across].ravel()
            if block.min() >= 0:
                found.append(block)
    return found


def _subset(place: SensorLayout, chosen: NDArray[np.intp]) -> SensorLayout:
    row, column = (index[chosen] for index in np.nonzero(place.mask))
    mask = np.zeros_like(place.mask)
    mask[row, column] = True
    return replace(place, mask=mask, local=place.local[chosen], illumination=place.illumination[chosen])


def _coarse(place: SensorLayout, blocks: list[NDArray[np.intp]], across: int) -> SensorLayout:
    """Each block as one sub-aperture."""
    n, edge = len(place.mask) // across, len(place.mask) % across // 2
    row, column = ((index[[block[0] for block in blocks]] - edge) // across for index in np.nonzero(place.mask))
    mask = np.zeros((n, n), bool)
    mask[row, column] = True
    return replace(
        place,
        size=place.size * across,
        mask=mask,
        local=np.array([place.local[block].mean(axis=0) for block in blocks]),
        illumination=np.array([place.illumination[block].mean() for block in blocks]),
    )
