"""The histogram of latencies."""

import time

import numpy as np
import pytest

from srtomo_rtc import native
from srtomo_rtc.latency import LatencyHistogram


def test_quantiles_of_many_latencies():
    """Against the sorted values, to a bin of 1/16 octave; never below."""
    values = (np.random.default_rng(1).lognormal(12, 0.7, 20_000)).astype(int)  # about 160 us
    histogram = LatencyHistogram(deadline_ns=400_000)
    for value in values:
        histogram.add(int(value))
    for share in (0.1, 0.5, 0.99, 0.999):
        exact = np.quantile(values, share, method="inverted_cdf") * 1e-9
        assert exact <= histogram.quantile(share) <= exact * 2 ** (1 / 16) * 1.0001
    assert histogram.quantile(1.0) == values.max() * 1e-9 == histogram.max_ns * 1e-9
    assert histogram.misses == (values > 400_000).sum()
    assert histogram.std == pytest.approx(values.std() * 1e-9, rel=1e-9)
    assert histogram.counts.sum() == len(values)


def test_nothing_was_counted():
    histogram = LatencyHistogram(1000)
    assert (histogram.quantile(0.5), histogram.std, histogram.max_ns, histogram.misses) == (0.0, 0.0, 0, 0)


def test_a_stamp_of_the_system_s_clock_by_the_monotonic_one():
    """Never before nothing was there nor after now, whatever the system's clock does; without a stamp it is now."""
    received = native.lib.srt_received
    for ago in (10**8, -(10**12), None):
        before, stamp = time.monotonic_ns(), 0 if ago is None else time.time_ns() - ago
        found, after = received(stamp, before - 10**9), time.monotonic_ns()
        early, late = (ago - 10**6, ago + 10**6) if ago == 10**8 else (0, 0)  # two clocks are read
        assert before - late <= found <= after - early
    looked = time.monotonic_ns() - 10**6
    assert received(time.time_ns() - 10**12, looked) == looked  # the clock was set forward meanwhile


@pytest.mark.parametrize("latency", [-5, 0, 1, 999, 1000, 1001, 10**9, 10**12, 10**18])
def test_any_latency_has_a_bin(latency):
    histogram = LatencyHistogram(10**9)
    histogram.add(latency)
    assert histogram.counts.sum() == 1
    assert histogram.misses == (latency > 10**9)


def test_memory_is_constant():
    histogram = LatencyHistogram(1000)
    counts = histogram.counts
    for latency in range(0, 10**7, 1111):
        histogram.add(latency)
    assert histogram.counts is counts
