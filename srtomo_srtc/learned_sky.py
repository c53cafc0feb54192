"""The sky that a window of telemetry tells: strengths and noise, and winds where they are asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from srtomo_core.layout import Layout
from srtomo_core.system import System
from srtomo_srtc.learn import LIMIT, Group, Learned, solve, winds_at
from srtomo_srtc.learn_wind import LayerWind, learn_winds, wind_of_all, with_winds
from srtomo_srtc.telemetry import Statistics
from srtomo_srtc.wind import winds as winds_of
from srtomo_srtc.wind import with_trusted_winds


@dataclass(frozen=True, eq=False)
class LearnedSky:
    """What a window told.

    Attributes:
        learned: strengths and noise.
        system: the instrument under that sky.
        winds: of each turbulent layer of ``system``; empty where they were not asked for.
    """

    learned: Learned
    system: System
    winds: tuple[LayerWind, ...] = ()

    def wind_of(self, group: Group) -> LayerWind | None:
        """Of the layers that are told as one, together; None where it was not asked for, or there is no turbulence."""
        turbulent = np.flatnonzero(self.learned.fractions > 0)
        layers = [wind for l, wind in zip(turbulent, self.winds) if l in group.layers]
        return wind_of_all(layers) if layers else None


def learned_sky(
    system: System,
    window: Statistics,
    *,
    winds: bool = False,
    layout: Layout | None = None,
    altitudes: Sequence[float] | None = None,
    limit: int = LIMIT,
) -> LearnedSky:
    """Fit a window.

    Args:
        system: the instrument as its file says.
        winds: learn them too, layer by layer; each is believed as far as it is known, and where it is not seen as the
            file has it. The errors of all else are those that go with these winds; without, with the file's.
        layout: where sensors are taken to be; as in the system when not given.
        altitudes, limit: as :func:`~srtomo_srtc.learn.learn` has them.

    Raises:
        LearnError: no sky can be told from it.
        ValueError: as of ``learn``, or winds are asked for and there are no lagged moments.
    """
    solution = solve(system, window, layout=layout, altitudes=altitudes, limit=limit)
    learned = solution.told()
    believed = learned.system(system, layout=layout)
    if not winds:
        return LearnedSky(learned, believed)
    found = learn_winds(believed, window, layout)
    believed = with_winds(believed, found)
    velocity = winds_at(system, learned.altitudes)
    velocity[learned.fractions > 0] = winds_of(believed)
    trusted = with_trusted_winds(believed, [0.0 if wind.reason else wind.sigma for wind in found])
    return LearnedSky(solution.told(velocity), trusted, found)


def lags_of(system: System, every: int) -> tuple[int, ...]:
    """Lags, in exposures, at which telemetry shows the winds: of half a sub-aperture and a whole one at 10 m/s.

    Args:
        every: exposures from one counted frame to the next; lags are multiples of it.
    """
    size = min(system.telescope.diameter / sensor.subapertures for sensor in system.sensors)
    return tuple(every * max(i, round(i * size / 20 * system.loop.rate / every)) for i in (1, 2))
