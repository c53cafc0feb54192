"""Products with the slope covariance that never form it: by FFT, where sensors are only shifted (section 4.1).

Towards stars at one range, the nodes of sensors of one size and clocking are lattices that differ by a shift on every
layer. The covariance of the wavefront at their nodes depends on rows and columns through differences alone (block
Toeplitz with Toeplitz blocks): a product with it is a convolution. Sparse gradient operators on both sides make slopes
of that, also at a partly lit edge, where the covariance of slopes is not Toeplitz itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import fft, sparse

from srtomo_srtc.atmosphere import Profile
from srtomo_srtc.covariance import Sightline, Turbulence, wavefront_covariance
from srtomo_srtc.geometry import Footprints, Lattice, SeenLattice

Array = NDArray[np.float64]

_FEW = 32  # slopes: a sensor with no more, for tip-tilt or so, may be any; it is correlated densely
_COLUMNS = 32  # transformed at a time
_SAME = 1e-6  # steps: by less than this two lattices may differ across the pupil but for a shift


class ToeplitzCovariance:
    """Sigma_ss of some sensors as a product.

    Attributes:
        n_slopes: of all sensors.
    """

    def __init__(self, profile: Profile, sensors: Sequence[Sightline], names: Sequence[str]) -> None:
        """Transform the covariance of every pair of lattices.

        Args:
            names: of the sensors, for errors.

        Raises:
            ValueError: a sensor is rotated against the others, of another size, or its star is at another range; those
                with a few slopes only excepted.
        """
        self.n_slopes = sum(s.gradient.shape[0] for s in sensors)
        slopes = np.split(np.arange(self.n_slopes), np.cumsum([s.gradient.shape[0] for s in sensors])[:-1])
        shifted, few = _sort(sensors, names)
        self._shifted = np.concatenate([slopes[i] for i in shifted])
        self._few = np.concatenate([np.zeros(0, np.int64), *(slopes[i] for i in few)])
        self._gradient = sparse.block_diag([sensors[i].gradient for i in shifted], format="csr")
        self._divergence = self._gradient.T.tocsr()

        lattices = [_seen(sensors[i]) for i in shifted]
        relative = [(s.row - s.row.min(), s.column - s.column.min()) for s in (seen.lattice for seen in lattices)]
        height, width = (1 + max(int(at[axis].max()) for at in relative) for axis in (0, 1))
        self._shape = (len(lattices), height, width)
        self._nodes = np.concatenate(
            [np.ravel_multi_index((np.full_like(r, k), r, c), self._shape) for k, (r, c) in enumerate(relative)]
        )
        self._padded = tuple(fft.next_fast_len(2 * n - 1, real=True) for n in (height, width))
        self._spectra = np.empty((len(lattices), len(lattices), self._padded[0], self._padded[1] // 2 + 1), complex)
        for i, first in enumerate(lattices):
            for j, second in enumerate(lattices[: i + 1]):
                self._spectra[i, j] = fft.rfft2(self._kernel(profile, first, second))
                self._spectra[j, i] = self._spectra[i, j].conj()

        turbulence = Turbulence.covering(profile, [s.nodes for s in sensors])
        self._columns = np.hstack(
            [np.zeros((self.n_slopes, 0)), *(_with_all_slopes(turbulence, sensors, sensors[i]) for i in few)]
        )

    @staticmethod
    def bytes_needed(sensors: Sequence[Sightline]) -> float:
        """At most, to hold it and to multiply with it."""
        lattices = [_seen(s).lattice for s in sensors]
        padded = 4 * max((np.ptp(s.row) + 1.0) * (np.ptp(s.column) + 1) for s in lattices)
        return 8 * padded * len(sensors) * (len(sensors) + 4 * _COLUMNS)

    def product(self, v: Array) -> Array:
        """Sigma_ss times slopes (n_slopes, n), rad^2 times theirs."""
        out = self._columns @ v[self._few]
        out[self._few] += self._columns[self._shifted].T @ v[self._shifted]
        for start in range(0, v.shape[1], _COLUMNS):
            columns = slice(start, start + _COLUMNS)
            out[self._shifted, columns] += self._convolve(v[self._shifted, columns])
        return out

    def _convolve(self, v: Array) -> Array:
        n = v.shape[1]
        nodes = np.zeros((n, math.prod(self._shape)))
        nodes[:, self._nodes] = (self._divergence @ v).T
        waves = fft.rfft2(nodes.reshape(n, *self._shape), s=self._padded)
        convolved = np.empty_like(waves)
        for i, row in enumerate(self._spectra):
            convolved[:, i] = sum(row[j] * waves[:, j] for j in range(len(row)))
        nodes = fft.irfft2(convolved, s=self._padded)[:, :, : self._shape[1], : self._shape[2]].reshape(n, -1)
        return np.asarray(self._gradient @ nodes[:, self._nodes].T)

    def _kernel(self, profile: Profile, first: SeenLattice, second: SeenLattice) -> Array:
        """Covariance between nodes of two lattices by the difference of their places, wrapped around."""
        _, height, width = self._shape
        down, right = np.arange(1 - height, height), np.arange(1 - width, width)
        lattice, corner = first.lattice, second.lattice
        row, column = np.meshgrid(down + lattice.row.min(), right + lattice.column.min(), indexing="ij")
        a = _on_layers(first, replace(lattice, row=row.ravel(), column=column.ravel()))
        b = _on_layers(
            second, replace(corner, row=corner.row.min(keepdims=True), column=corner.column.min(keepdims=True))
        )
        kernel = np.zeros(self._padded)
        kernel[np.ix_(down, right)] = wavefront_covariance(Turbulence.covering(profile, [a, b]), a, b).reshape(
            row.shape
        )
        return kernel


def _on_layers(seen: SeenLattice, lattice: Lattice) -> Footprints:
    x, y = lattice.points()
    cones = seen.cones[:, None]
    return Footprints(cones * x + seen.offsets[:, :1], cones * y + seen.offsets[:, 1:])


def _with_all_slopes(turbulence: Turbulence, sensors: Sequence[Sightline], one: Sightline) -> Array:
    """Covariance of all sensors' slopes with those of one, rad^2."""
    blocks = [s.gradient @ wavefront_covariance(turbulence, s.nodes, one.nodes) for s in sensors]
    return np.asarray((one.gradient @ np.concatenate(blocks).T).T)


def _seen(sensor: Sightline) -> SeenLattice:
    assert sensor.seen is not None
    return sensor.seen


def _sort(sensors: Sequence[Sightline], names: Sequence[str]) -> tuple[list[int], list[int]]:
    """Sensors that are shifted against each other, and others with a few slopes."""
    model = max(range(len(sensors)), key=lambda i: sensors[i].gradient.shape[0])
    shifted, few = [], []
    for i, sensor in enumerate(sensors):
        reason = _difference(_seen(sensor), _seen(sensors[model]))
        if not reason:
            shifted.append(i)
        elif sensor.gradient.shape[0] <= _FEW:
            few.append(i)
        else:
            raise ValueError(
                f"products by FFT: expected sensors that are only shifted, {names[i]} {reason} {names[model]}"
            )
    return shifted, few


def _difference(a: SeenLattice, b: SeenLattice) -> str:
    across = max(np.ptp(b.lattice.row), np.ptp(b.lattice.column))
    if abs(a.lattice.step / b.lattice.step - 1) * across > _SAME:
        return "has sub-apertures of another size than"
    if abs(math.remainder(a.lattice.rotation - b.lattice.rotation, 2 * math.pi)) * across > _SAME:
        return "is rotated against"
    return "" if np.allclose(a.cones, b.cones, rtol=0, atol=1e-12) else "looks at a star at another range than"
