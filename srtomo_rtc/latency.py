"""Latencies in a fixed histogram: constant memory, one increment a frame."""

from __future__ import annotations

import ctypes
import math

import numpy as np

from srtomo_rtc import native

_PER_OCTAVE = 16
_FIRST = 1000  # ns; everything faster shares the first bin


class LatencyHistogram:
    """Counts in bins of 1/16 octave from 1 us to 17 s: quantiles to 4.4 %. One thread adds; any thread may read.

    Args:
        deadline_ns: latency above which one counts as a miss.
        shared: the frame path's own; the deadline is in it.
    """

    def __init__(self, deadline_ns: int = 0, shared: native.Latency | None = None) -> None:
        self._c = native.Latency(deadline_ns=deadline_ns) if shared is None else shared
        self.counts = np.ctypeslib.as_array(self._c.counts)

    def add(self, nanoseconds: int) -> None:
        """Count one latency."""
        native.lib.srt_latency_add(ctypes.byref(self._c), nanoseconds)

    @property
    def deadline_ns(self) -> int:
        """Latency above which one counts as a miss."""
        return int(self._c.deadline_ns)

    @property
    def misses(self) -> int:
        """Latencies above the deadline."""
        return int(self._c.misses)

    @property
    def max_ns(self) -> int:
        """The largest."""
        return int(self._c.max_ns)

    @property
    def std(self) -> float:
        """Standard deviation, s; 0 before the first count."""
        n = int(self.counts.sum())
        if n == 0:
            return 0.0
        mean = self._c.sum / n
        # another thread may be adding: the three are not of one moment
        return math.sqrt(max(self._c.squares / n - mean * mean, 0.0)) * 1e-9

    def summary(self) -> dict[str, float]:
        """What HrtcStatus carries, s: p50, p99, p999, max and std."""
        return {
            "p50": self.quantile(0.5),
            "p99": self.quantile(0.99),
            "p999": self.quantile(0.999),
            "max": self.max_ns * 1e-9,
            "std": self.std,
        }

    def quantile(self, share: float) -> float:
        """Upper edge of the bin that holds quantile ``share`` (0 to 1), s; 0 before the first count."""
        total = np.cumsum(self.counts)
        if total[-1] == 0:
            return 0.0
        place = int(np.searchsorted(total, share * total[-1]))
        return min(_FIRST * 2.0 ** ((place + 1) / _PER_OCTAVE), float(self.max_ns)) * 1e-9
