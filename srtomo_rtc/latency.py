"""Latencies in a fixed histogram: constant memory, one increment a frame."""

from __future__ import annotations

import math

import numpy as np

_PER_OCTAVE = 16
_FIRST = 1000  # ns; everything faster shares the first bin
_OCTAVES = 24  # up to 17 s


class LatencyHistogram:
    """Counts in bins of 1/16 octave from 1 us: quantiles to 4.4 %. One thread adds; any thread may read."""

    def __init__(self, deadline_ns: int) -> None:
        self.counts = np.zeros(_PER_OCTAVE * _OCTAVES, np.int64)
        self.deadline_ns = deadline_ns
        self.misses = 0
        self.max_ns = 0

    def add(self, nanoseconds: int) -> None:
        """Count one latency."""
        place = int(_PER_OCTAVE * math.log2(nanoseconds / _FIRST)) if nanoseconds > _FIRST else 0
        self.counts[min(place, len(self.counts) - 1)] += 1
        if nanoseconds > self.max_ns:
            self.max_ns = nanoseconds
        if nanoseconds > self.deadline_ns:
            self.misses += 1

    def quantile(self, share: float) -> float:
        """Upper edge of the bin that holds quantile ``share`` (0 to 1), s; 0 before the first count."""
        total = np.cumsum(self.counts)
        if total[-1] == 0:
            return 0.0
        place = int(np.searchsorted(total, share * total[-1]))
        return min(_FIRST * 2.0 ** ((place + 1) / _PER_OCTAVE), float(self.max_ns)) * 1e-9
