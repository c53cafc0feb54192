"""The plant: what a loop sees of sky, sensors and mirrors. In lockstep or at its own pace, the same every run."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from srtomo_core.layout import Layout
from srtomo_core.system import InstrumentError, System
from srtomo_sim.course import Change, Course, alters_turbulence
from srtomo_sim.mirror import DelayLine, OnMirror
from srtomo_sim.shack_hartmann import dark_slopes, measured_noise, noise_correlation, noise_sigma
from srtomo_sim.sky import Sky, WavefrontError
from srtomo_sim.turbulence import Screens

_NOISE = 0x6E6F697365  # keeps the noise of a seed apart from its screens


class Plant:
    """An instrument under a prepared sky, its mirrors behind the loop's delay line; all three may change on the way.

    ``y = s - G m + jitter + noise``, with m the commands on the mirrors averaged over the exposure. What is random in a
    frame depends on seed and frame alone, whatever the order or pace of the calls. Not safe for calls from several
    threads at once.

    Stars of tip-tilt's own loop expose over several of these exposures: :meth:`tip_tilt`. Mean slopes are the mean
    wavefront's; of what :meth:`measure` returns theirs are without noise, and no camera's.
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
        self._changing = threading.Lock()
        self._key = np.array([sky.seed if seed is None else seed, _NOISE], np.uint64)
        self._light = _Light.of(Course(system, sky.course.changes), sky.layout)
        self._measured = [(own, factor.astype(np.float32)) for own, factor in measured_noise(system, sky.layout)]
        self._jitter = np.array([star.jitter for star in system.guide_stars], np.float32)
        self._star = [system.guide_stars.index(system.star_of(sensor)) for sensor in system.sensors]
        self._line = DelayLine(system.loop.delay, sky.layout.n_commands)
        self._now = 0
        self._ready = sky.n_frames
        self._screens: Screens | None = None  # as long as there is something to catch up with
        self._late: set[int] = set()
        self._own = np.zeros(sky.layout.n_slopes, bool)
        for w in sky.layout.tip_tilt_sensors:
            self._own[sky.layout.slopes_of(w)] = True
        self._exposing: dict[int, NDArray[np.float32]] = {}  # what their light has said so far, by exposure
        self._exposed: dict[int, NDArray[np.float32]] = {}  # their frames that are over and not read

    def truth(self, frame: int) -> System:
        """The instrument as it is in the middle of an exposure: its sky, its light and where its sensors are."""
        return self._light.course.truth(frame)

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
        sky = self._sky
        if not 0 <= frame < sky.n_frames:
            raise IndexError(f"frame {frame}: the sky was prepared for {sky.n_frames} frames")
        if frame >= self._ready:
            self.catch_up()
        place, noise = sky.place(frame), self._light.noise(frame)
        draw = np.random.Generator(np.random.Philox(key=self._key, counter=[0, frame, 0, 0]))
        tilts = draw.standard_normal((len(self._jitter), 2), np.float32) * self._jitter[:, None]
        white = draw.standard_normal(sky.layout.n_slopes, np.float32)
        slopes = white.copy()
        for own, correlation in noise.correlated:
            x, y = np.split(slopes[own], 2)
            y[:] = correlation * x + np.sqrt(1 - correlation**2) * y
        slopes *= noise.sigma
        for own, factor in self._measured:
            slopes[own] = factor @ white[own]
        own_noise = np.where(self._own, slopes, 0)
        slopes -= own_noise
        dark = noise.dark
        in_the_dark = slopes[dark]
        slopes += sky.turbulence(frame)
        slopes -= place.interaction @ self._line.shape(frame)
        for i, layout in enumerate(place.layout.sensors):
            tilt = tilts[self._star[i]]
            c, s = np.cos(layout.rotation), np.sin(layout.rotation)
            mine = slopes[sky.layout.slopes_of(i)]
            mine[: layout.n_valid] += c * tilt[0] + s * tilt[1]
            mine[layout.n_valid :] += c * tilt[1] - s * tilt[0]
        slopes[dark] = in_the_dark
        self._expose(frame, slopes, own_noise)
        if self._line.is_late(frame):
            self._late.add(frame)
        self._now = max(self._now, frame + 1)
        return slopes

    def _expose(self, frame: int, slopes: NDArray[np.float32], noise: NDArray[np.float32]) -> None:
        """One exposure more for the stars of tip-tilt's own loop; they are read out, with noise, after the last."""
        n = self._sky.system.loop.tip_tilt_frames
        if not self._own.any():
            return
        self._exposing[frame] = slopes
        if frame % n == n - 1:
            parts = [self._exposing.pop(k, None) for k in range(frame + 1 - n, frame + 1)]
            whole = [part for part in parts if part is not None]
            if len(whole) == n:
                self._exposed[frame // n] = np.mean(whole, axis=0, dtype=np.float32) + noise

    def tip_tilt(self, frame: int) -> tuple[int, NDArray[np.float32]] | None:
        """What stars of tip-tilt's own loop send just before the slopes of an exposure just measured.

        Returns:
            Their frame, and (n_slopes,) rad of which those of their sensors count; None: nothing is due.
        """
        loop = self._sky.system.loop
        own, rest = divmod(frame + 1 - loop.tip_tilt_wait, loop.tip_tilt_frames)
        slopes = self._exposed.pop(own - 1, None) if rest == 0 else None
        return None if slopes is None else (own - 1, slopes)

    def change(self, change: Change) -> bool:
        """Change sky, light or sensors from an exposure on that has not been measured.

        Returns:
            Whether frames from there on have to be computed anew: :meth:`catch_up`.

        Raises:
            InstrumentError: the change is refused, or it is too late for it.
        """
        if change.frame < self._now:
            raise InstrumentError(f"frame {change.frame}: exposures up to {self._now - 1} are over")
        sky = self._sky.changed(change)
        light = _Light.of(self._light.course.extended(change), sky.layout)
        anew = alters_turbulence(change) and change.frame < sky.n_frames
        with self._changing:
            self._sky = sky
            self._light = light
            if anew:
                self._ready = min(self._ready, change.frame)
        return anew

    @property
    def ready(self) -> int:
        """The first exposure that a change has left to be computed anew; :meth:`measure` would wait for it."""
        return self._ready

    def catch_up(self, n_frames: int | None = None) -> None:
        """Compute exposures that a change has touched anew, the next ``n_frames`` or all of them.

        On any thread, of which one at a time; another may measure exposures before :attr:`ready` meanwhile.
        """
        while (first := self._ready) < (sky := self._sky).n_frames:
            stop = sky.n_frames if n_frames is None else min(first + n_frames, sky.n_frames)
            if self._screens is None:
                self._screens = Screens(sky.system, sky.seed)
            self._screens.course = sky.course
            part = sky.compute(self._screens, first, stop, lambda done: None)
            with self._changing:
                # unless there was yet another change meanwhile
                if sky is self._sky:
                    sky.put(part)
                    self._ready = stop
                    if n_frames is not None and stop < sky.n_frames:
                        return
        self._screens = None

    def command(self, frame: int, commands: ArrayLike, arrival: float | None = None) -> None:
        """Hand in the commands made from a frame's slopes.

        Args:
            commands: (n_commands,) m of wavefront.
            arrival: when they came, in frame times since the start of exposure 0; by default the end of the last
                exposure that was measured, which is what lockstep means.

        Raises:
            ValueError: wrong shape, not finite, or of a frame that has not been measured: nobody can have made it.
        """
        if not 0 <= frame < self._now:
            raise ValueError(f"command of frame {frame}: exposures up to {self._now - 1} are over")
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


@dataclass(frozen=True, eq=False)
class _Noise:
    """Noise of slopes whose covariance was not measured.

    Attributes:
        sigma: (n_slopes,) rad.
        correlated: slopes of a sensor whose spots are not round, and the correlation of x with y (n_valid,).
        dark: slopes (indices) without light, which are noise alone.
    """

    sigma: NDArray[np.float32]
    correlated: list[tuple[slice, NDArray[np.float32]]]
    dark: NDArray[np.intp]

    @classmethod
    def of(cls, system: System, layout: Layout) -> _Noise:
        return cls(
            noise_sigma(system, layout).astype(np.float32),
            [
                (layout.slopes_of(i), correlation.astype(np.float32))
                for i, correlation in enumerate(noise_correlation(system, layout))
                if correlation.any()
            ],
            dark_slopes(system, layout),
        )

    def towards(self, other: _Noise, share: float) -> _Noise:
        """Variances and covariances that lie between two noises' own."""
        sigma = np.sqrt((1 - share) * self.sigma**2 + share * other.sigma**2).astype(np.float32)
        correlated = []
        for (own, mine), (_, theirs) in zip(self.correlated, other.correlated, strict=True):
            a, b, both = (np.prod(np.split(s[own], 2), axis=0) for s in (self.sigma, other.sigma, sigma))
            between = ((1 - share) * mine * a + share * theirs * b) / both
            correlated.append((own, np.asarray(between, np.float32)))
        return _Noise(sigma, correlated, self.dark)


@dataclass(frozen=True, eq=False)
class _Light:
    """What the noise is in which exposure: at the beginning and at the end of each stretch of a course."""

    course: Course
    noises: tuple[tuple[_Noise, _Noise], ...]

    @classmethod
    def of(cls, course: Course, layout: Layout) -> _Light:
        return cls(
            course,
            tuple(
                (noise, noise if s.after is s.before else _Noise.of(s.after, layout))
                for s in course.stretches
                for noise in [_Noise.of(s.before, layout)]
            ),
        )

    def noise(self, frame: int) -> _Noise:
        stretch = self.course.at(frame)
        before, after = self.noises[self.course.stretches.index(stretch)]
        if stretch.after is stretch.before:
            return after
        return before.towards(after, float(stretch.share(np.array([frame]))[0]))


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
