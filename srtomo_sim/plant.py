"""The plant: what a loop sees of sky, sensors and mirrors. In lockstep or at its own pace, the same every run."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from srtomo_core.system import System
from srtomo_sim.mirror import DelayLine, OnMirror
from srtomo_sim.shack_hartmann import noise_correlation, noise_sigma
from srtomo_sim.sky import Sky, WavefrontError

_NOISE = 0x6E6F697365  # keeps the noise of a seed apart from its screens


class Plant:
    """An instrument under a prepared sky, its mirrors behind the loop's delay line.

    ``y = s - G m + jitter + noise``, with m the commands on the mirrors averaged over the exposure. What is random in a
    frame depends on seed and frame alone, whatever the order or pace of the calls. Not safe for calls from several
    threads at once.
    """

    def __init__(self, system: System, sky: Sky, seed: int | None = None) -> None:
        """Make a plant.

        Args:
            system: of the sky's layout, sky and frame rate; photons, noise, jitter and delay may be others.
            seed: of noise and jitter; by default that of the sky.

        Raises:
            ValueError: the sky was prepared for another instrument.
        """
        for key in ("telescope", "zenith_angle", "atmosphere", "science", "mirrors"):
            if getattr(system, key) != getattr(sky.system, key):
                raise ValueError(f"{key}: the sky was prepared for another")
        if _geometry(system) != _geometry(sky.system):
            raise ValueError("sensors or guide_stars: the sky was prepared for others")
        if system.loop.rate != sky.system.loop.rate:
            raise ValueError(f"loop.rate: the sky was prepared for {sky.system.loop.rate:g} Hz")
        self._sky = sky
        self._key = np.array([sky.seed if seed is None else seed, _NOISE], np.uint64)
        self._sigma = noise_sigma(system, sky.layout).astype(np.float32)
        self._correlated = [
            (sky.layout.slopes_of(i), correlation.astype(np.float32))
            for i, correlation in enumerate(noise_correlation(system, sky.layout))
            if correlation.any()
        ]
        self._jitter = np.array([star.jitter for star in system.guide_stars], np.float32)
        self._star = [system.guide_stars.index(system.star_of(sensor)) for sensor in system.sensors]
        self._line = DelayLine(system.loop.delay, sky.layout.n_commands)
        self._now = 0
        self._late: set[int] = set()

    @property
    def sky(self) -> Sky:
        """The sky overhead."""
        return self._sky

    @property
    def late_commands(self) -> int:
        """Exposures measured so far in which the command that was due had not come: the mirror was held."""
        return len(self._late)

    def measure(self, frame: int) -> NDArray[np.float32]:
        """Slopes of an exposure, (n_slopes,) rad, with what has come for the mirrors so far.

        Raises:
            IndexError: beyond the prepared sky.
        """
        if not 0 <= frame < self._sky.n_frames:
            raise IndexError(f"frame {frame}: the sky was prepared for {self._sky.n_frames} frames")
        draw = np.random.Generator(np.random.Philox(key=self._key, counter=[0, frame, 0, 0]))
        tilts = draw.standard_normal((len(self._jitter), 2), np.float32) * self._jitter[:, None]
        slopes = draw.standard_normal(self._sky.layout.n_slopes, np.float32)
        for own, correlation in self._correlated:
            x, y = np.split(slopes[own], 2)
            y[:] = correlation * x + np.sqrt(1 - correlation**2) * y
        slopes *= self._sigma
        slopes += self._sky.slopes[frame]
        slopes -= self._sky.interaction @ self._line.shape(frame)
        for i, layout in enumerate(self._sky.layout.sensors):
            tilt = tilts[self._star[i]]
            c, s = np.cos(layout.rotation), np.sin(layout.rotation)
            mine = slopes[self._sky.layout.slopes_of(i)]
            mine[: layout.n_valid] += c * tilt[0] + s * tilt[1]
            mine[layout.n_valid :] += c * tilt[1] - s * tilt[0]
        if self._line.is_late(frame):
            self._late.add(frame)
        self._now = max(self._now, frame + 1)
        return slopes

    def command(self, frame: int, commands: ArrayLike, arrival: float | None = None) -> None:
        """Hand in the commands made from a frame's slopes.

        Args:
            commands: (n_commands,) m of wavefront.
            arrival: when they came, in frame times since the start of exposure 0; by default the end of the last
                exposure that was measured, which is what lockstep means.

        Raises:
            ValueError: wrong shape, or not finite.
        """
        self._line.put(frame, commands, self._now if arrival is None else arrival)

    def on_mirror(self, frame: int) -> OnMirror:
        """Which commands were on the mirrors in an exposure just measured."""
        return self._line.on(frame)

    def wfe(self, frame: int) -> WavefrontError:
        """Residual in the science directions at the middle of an exposure just measured.

        Where the mirrors move within the exposure, the mean of the squares by the shares of the two shapes.

        Raises:
            ValueError: the sky does not know the science directions in this frame.
        """
        state = self._line.on(frame)
        after = self._sky.error(frame, self._line.commands(state.frame))
        if state.fraction == 1:
            return after
        before = self._sky.error(frame, self._line.commands(state.before))
        f = state.fraction
        return WavefrontError(*(np.sqrt(f * a**2 + (1 - f) * b**2) for a, b in zip(after, before, strict=True)))


def _geometry(system: System) -> list[tuple[object, ...]]:
    """What the slopes of the sky depend on, sensor by sensor."""
    return [
        (
            sensor.subapertures,
            sensor.illumination_threshold,
            sensor.shift,
            sensor.rotation,
            star.position,
            star.altitude,
        )
        for sensor in system.sensors
        for star in [system.star_of(sensor)]
    ]
