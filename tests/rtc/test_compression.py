"""The int16 kernel in the loop: how far it is off, where it is refused, and that its recordings replay."""

from __future__ import annotations

import numpy as np
import pytest

from srtomo_core import wire
from srtomo_core.bag import BagReader
from srtomo_core.messages import decode
from srtomo_rtc.compression import int16_to_noise
from srtomo_rtc.replay import Replay
from srtomo_rtc.swap import Refused


def test_the_stated_error_is_that_of_uniform_rounding(bench, mini):
    """From closed form: steps of the largest element of a row and sensor / 32767, over sqrt(12), in each element."""
    system, layout, R = mini.system, mini.layout, mini.a.R[0].astype(float)
    error = noise = 0.0
    for w, (sensor, own) in enumerate(zip(system.sensors, layout.sensors, strict=True)):
        block = R[:, layout.slopes_of(w)]
        electrons = sensor.photons * own.size**2 * own.illumination / system.loop.rate
        photon = np.tile((sensor.spot_fwhm / 2.3548 * sensor.excess_noise) ** 2 / electrons, 2)
        tilt = 0.170 * (0.5e-6 / own.size) ** 2 * (own.size / system.los_r0) ** (5 / 3)
        error += np.sum((np.abs(block).max(axis=1) / 32767) ** 2) / 12 * np.sum(photon + tilt)
        noise += np.sum(block**2 @ photon)
    found = int16_to_noise(system, layout, mini.a.R[0])
    assert 0 < found < 0.01
    assert str(bench(kernel="int16").swap.stage_whole(mini.a).check).endswith(
        f"16 bits err by {found:.1g} of photon noise"
    )
    assert found == pytest.approx(np.sqrt(error / noise), rel=0.1)


def test_commands_of_both_kernels_agree_within_it(bench, mini):
    both = [bench(kernel=kernel) for kernel in ("float32", "int16")]
    for made in both:
        made.close(mini.a)
        made.run(range(60))
    a, b = (np.array([command.commands for command in made.commands]) for made in both)
    assert 0 < np.abs(a - b).max() < 1e-4 * np.abs(a).max()


def test_it_is_refused_where_noise_is_less(bench, mini):
    """A million times the light, a thousandth of the noise."""
    sensors = tuple(sensor.model_copy(update={"photons": 1e6 * sensor.photons}) for sensor in mini.system.sensors)
    bright = mini.system.model_copy(update={"sensors": sensors})
    ratio = int16_to_noise(mini.system, mini.layout, mini.a.R[0])
    assert int16_to_noise(bright, mini.layout, mini.a.R[0]) == pytest.approx(1e3 * ratio, rel=0.05)
    bench(kernel="float32", system=bright).swap.stage_whole(mini.a)
    with pytest.raises(Refused, match=r"16 bits would err by 0\.\d+ of what photon noise leaves"):
        bench(kernel="int16", system=bright).swap.stage_whole(mini.a)


def test_a_recording_says_so_and_replays(bench, mini, tmp_path):
    made = bench(bag=tmp_path / "bag", kernel="int16")
    made.close(mini.a)
    made.run(range(30))
    made.finish()
    with BagReader(tmp_path / "bag") as reader:
        kernels = {decode(wire.EVENT.type, message.data).kernel for message in reader.messages(f"/{wire.EVENT.name}")}
        outcome = Replay(reader).run()
    assert "subapertures-int16-rowscale-1thread" in kernels
    assert (outcome.compared, outcome.differing, outcome.skipped) == (30, 0, 0)
