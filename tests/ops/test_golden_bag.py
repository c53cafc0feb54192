"""The golden bag of ``mini``: see bags/README.md."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from srtomo_core import wire
from srtomo_core.bag import BagReader, BagWriter
from srtomo_rtc.loop import Verdict
from srtomo_rtc.replay import Outcome, Replay

BAG = Path(__file__).resolve().parents[2] / "bags" / "mini"
FRAMES = 150


def replay(path: Path, start: int = 0) -> Outcome:
    with BagReader(path) as reader:
        assert reader.cut is None
        return Replay(reader).run(start)


def rewritten(path: Path, topic: wire.Topic, change) -> Path:
    """A copy of the bag with the messages of a topic that ``change(index, data)`` returns in their place."""
    with BagReader(BAG) as reader, BagWriter(path, reader.metadata) as writer:
        writer.declare_as(reader)
        index = 0
        for message in reader:
            data = message.data
            if message.topic == reader.topic(topic.name):
                data = change(index, data)
                index += 1
            writer.write(message.topic, message.type, data, message.log_time, message.log_time)
    return path


def last_bit_flipped(data: bytes) -> bytes:
    """The smallest bit of the last float."""
    return data[:-4] + bytes([data[-4] ^ 1]) + data[-3:]


def test_it_holds_what_it_is_for() -> None:
    assert sum(file.stat().st_size for file in BAG.iterdir()) < 800_000
    with BagReader(BAG) as reader:
        commands = [wire.read_dm_command(m.data) for m in reader.messages(reader.topic(wire.COMMAND.name))]
        events = [reader.decode(m) for m in reader.messages(reader.topic(wire.EVENT.name))]
        states = [reader.decode(m).frame for m in reader.messages(reader.topic(wire.STATE.name))]
    assert [command.frame for command in commands] == list(range(FRAMES))
    verdicts = Counter(Verdict(command.verdict).name for command in commands)
    assert verdicts["HOLD_NONFINITE"] == verdicts["HOLD_INCOMPLETE"] == 1
    assert verdicts["OPEN"] > 5 and verdicts["OK"] == FRAMES - 2 - verdicts["OPEN"]
    assert len({command.reconstructor for command in commands}) == 2
    assert len({command.settings for command in commands}) == 3
    kinds = [event.kind for event in events]
    assert {0, 1, 2, 4, 6} <= set(kinds) and kinds.count(2) == 2  # settings, loop, commits, staged, session
    assert sum(0 < frame < FRAMES - 1 for frame in states) >= 2
    assert max(np.abs(command.commands).max() for command in commands) > 100e-9


def test_a_profile_of_an_older_definition_is_read() -> None:
    """Made when the outer scale's error was one of its logarithm: what was there is there, and no interval was told."""
    with BagReader(BAG) as reader:
        profiles = [reader.decode(m) for m in reader.messages(reader.topic(wire.PROFILE.name))]
    assert [profile.source for profile in profiles] == ["ground", "file"]
    for profile in profiles:
        assert (profile.outer_scale, profile.outer_scale_low, profile.outer_scale_high) == (25, 0, 0)
        assert np.isnan(profile.r0_error) and np.isnan(profile.fraction_error).all()
    np.testing.assert_allclose(profiles[1].fraction, [0.6, 0.25, 0.15], rtol=1e-6)


def test_every_command_bit_for_bit() -> None:
    outcome = replay(BAG)
    assert (outcome.compared, outcome.differing, outcome.held) == (FRAMES, 0, 2), outcome
    assert (outcome.unanswered, outcome.skipped, outcome.gaps) == (0, 0, [])


@pytest.mark.parametrize("start", [1, 50, 61, 100, 140])
def test_from_the_middle(start: int) -> None:
    outcome = replay(BAG, start)
    assert (outcome.compared, outcome.differing) == (FRAMES - start, 0), outcome


def test_one_altered_command_is_one_difference(tmp_path: Path) -> None:
    bag = rewritten(tmp_path / "altered", wire.COMMAND, lambda i, data: last_bit_flipped(data) if i == 77 else data)
    outcome = replay(bag)
    assert (outcome.compared, outcome.differing) == (FRAMES, 1)
    assert outcome.first_differing[0].startswith("frame 77: 1 commands")


def test_one_altered_slope_shows_from_its_frame_on(tmp_path: Path) -> None:
    # the natural star's sensor closes each frame; the lowest bit of a slope may round away, the lowest of its exponent
    # cannot
    def change(index: int, data: bytes) -> bytes:
        message = wire.read_slope_frame(data)
        if message.frame != 70 or message.sensor != 3:
            return data
        return data[:-2] + bytes([data[-2] ^ 0x80]) + data[-1:]

    outcome = replay(rewritten(tmp_path / "altered", wire.SLOPES, change))
    assert outcome.compared == FRAMES
    assert outcome.first_differing[0].startswith("frame 70:")
    assert outcome.differing > 20
