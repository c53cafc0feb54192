"""Bags made by driving the HRTC itself: they replay bit for bit, and what was altered or lost shows, and where."""

from dataclasses import asdict

import numpy as np
import pytest

from srtomo_core import wire
from srtomo_core.bag import BagError, BagReader, BagWriter
from srtomo_core.messages import decode, definition, encode
from srtomo_rtc.events import EventKind
from srtomo_rtc.loop import Verdict
from srtomo_rtc.replay import Replay

SECOND = 10**9


def replay(path, start=0, supplied=None):
    with BagReader(path) as reader:
        return Replay(reader, supplied).run(start)


def rewrite(path, out, change):
    """A copy of a bag with each message replaced by ``change(topic, data)``; None drops it."""
    with BagReader(path) as reader, BagWriter(out, reader.metadata) as writer:
        for message in reader.messages():
            data = change(message.topic.lstrip("/"), message.data)
            if data is not None:
                writer.write(message.topic, message.type, data, message.log_time, message.log_time)
    return out


def clean(outcome) -> bool:
    return (outcome.differing, outcome.skipped, outcome.unanswered, outcome.gaps) == (0, 0, 0, [])


@pytest.fixture(scope="module")
def eventful(bench, mini, tmp_path_factory):
    """200 frames with everything in them that a bag can hold: (path, the bench that made it)."""
    path = tmp_path_factory.mktemp("bags") / "eventful"
    made = bench(bag=path, delay=1.6)
    made.publish(mini.a)
    made.publish(mini.c)
    made.swap.stage_whole(mini.a)
    made.run(range(10))  # open, without a reconstructor
    made.commit(mini.a)
    made.hrtc.loop.request(closed=True)
    made.run(range(10, 30))
    made.hrtc.want_snapshot()
    parts = made.messages(30)  # a sensor is missing
    made.offer(*parts[:2], *parts[3:])
    made.run(range(31, 40))
    slopes = made.sky.slopes(40)
    slopes[17] = np.nan
    made.frame(40, slopes)
    made.run(range(41, 50))
    made.offer(*(message for k in range(50, 57) for message in made.messages(k)))  # too many wait
    made.run(range(57, 60))
    made.swap.change_settings(leak=0.01, command_limit=8e-7)
    made.run(range(60, 80))
    made.swap.stage_whole(mini.c)
    made.commit(mini.c)
    made.run(range(80, 85))
    made.close_sensors(1)
    made.run(range(85, 87))
    made.frame(87, made.dark(87, 1))
    made.offer(*(message for w, message in enumerate(made.messages(88)) if w != 1))
    made.close_sensors(0, 1)  # only tip-tilt is left
    made.run(range(89, 94))
    made.close_sensors()
    made.run(range(94, 100))
    made.hrtc.want_snapshot()
    offset = np.random.default_rng(3).standard_normal(made.layout.n_commands).astype("f4") * np.float32(1e-8)
    made.swap.change_settings(offset=offset, slope_reference=-mini.G @ offset)
    made.run(range(100, 112))
    made.close_sensors(0)
    made.hrtc.want_snapshot()
    made.run(range(112, 120), lambda k: k < 118 or made.close_sensors())
    made.roll_back(mini.a)
    made.run(range(120, 123))
    made.close_sensors(2)  # without which this one can do nothing
    made.run(range(123, 126))
    made.close_sensors()
    made.run(range(126, 130))
    made.hrtc.loop.request(closed=False)
    made.run(range(130, 134))
    made.close_sensors(0, 1, 2, 3)  # the open loop relaxes on
    made.run(range(134, 137))
    made.close_sensors()
    made.run(range(137, 140))
    made.hrtc.loop.request(closed=True)
    made.swap.change_settings(polc=False, leak=0.1)
    made.run(range(140, 150))
    made.swap.change_settings(polc=True, fault_budget=3)
    made.run(range(150, 160))
    made.hrtc.want_snapshot()
    made.frame(166)  # six frames are missing: the loop opens by itself
    made.run(range(167, 180))
    made.hrtc.loop.request(closed=True)
    made.offer(*made.messages(180, timing=(170, 170, 1.0)))  # the mirror was held for long
    made.offer(*made.messages(181, timing=(-5, -5, 1.0)))  # and showed what nobody knows
    made.run(range(182, 199))
    made.hrtc.flatten()
    made.offer(*made.messages(199))
    made.finish()
    return path, made


def frame_of(topic, data):
    if topic == wire.COMMAND.name:
        return wire.read_dm_command(data).frame
    return wire.read_slope_frame(data).frame if topic == wire.SLOPES.name else None


def test_the_bag_holds_what_it_is_made_for(eventful):
    """Every verdict, and every kind of event that changes a command."""
    path, made = eventful
    assert {Verdict(command.verdict) for command in made.commands} == set(Verdict)
    with BagReader(path) as reader:
        kinds = {decode(message.type, message.data).kind for message in reader.messages("/hrtc/event")}
    assert kinds == {
        EventKind.SETTINGS, EventKind.LOOP, EventKind.COMMIT, EventKind.ROLLBACK, EventKind.SESSION,
    }  # fmt: skip
    assert len({command.reconstructor for command in made.commands}) == 3  # none, a, c
    assert [command.frame for command in made.commands] == list(range(200))


def test_bit_exact_from_the_start(eventful):
    path, made = eventful
    outcome = replay(path)
    assert clean(outcome), asdict(outcome)
    assert (outcome.compared, outcome.first_frame, outcome.last_frame) == (200, 0, 199)
    held = [command for command in made.commands if command.verdict not in (Verdict.OK, Verdict.OPEN)]
    assert outcome.held == len(held) >= 11


@pytest.mark.parametrize("start", [1, 30, 31, 60, 105, 110, 115, 165, 199])
def test_bit_exact_from_the_middle(eventful, start):
    outcome = replay(eventful[0], start)
    assert clean(outcome), asdict(outcome)
    assert (outcome.compared, outcome.first_frame) == (200 - start, start)


def test_the_middle_does_not_need_the_beginning(eventful, tmp_path):
    """Without anything of the frames before a recorded state, the replay goes on from there."""

    def late(topic, data):
        frame = frame_of(topic, data)
        return data if frame is None or frame > 100 else None

    outcome = replay(rewrite(eventful[0], tmp_path / "late", late), 101)
    assert clean(outcome), asdict(outcome)
    assert (outcome.compared, outcome.first_frame) == (99, 101)


@pytest.mark.parametrize("frame", [0, 15, 60, 130, 198])
def test_one_altered_command_is_one_that_differs(eventful, tmp_path, frame):
    def alter(topic, data):
        if topic == wire.COMMAND.name and frame_of(topic, data) == frame:
            data = data[:-1] + bytes([data[-1] ^ 1])
        return data

    outcome = replay(rewrite(eventful[0], tmp_path / "altered", alter))
    assert (outcome.compared, outcome.differing) == (200, 1)
    assert outcome.first_differing[0].startswith(f"frame {frame}: 1 commands")


def test_one_altered_verdict_or_reconstructor_differs(eventful, tmp_path):
    """The bits of the commands are not all that is compared."""

    def alter(topic, data):
        if topic == wire.COMMAND.name and frame_of(topic, data) in (20, 90):
            fields = wire.read_dm_command(data)
            if fields.frame == 20:
                fields = fields._replace(verdict=Verdict.OPEN)
            else:
                fields = fields._replace(reconstructor=7)
            writer = wire.DmCommandWriter("dm", len(fields.commands))
            writer.values[:] = fields.commands
            data = writer.write(*fields[:-1])
        return data

    outcome = replay(rewrite(eventful[0], tmp_path / "altered", alter))
    assert outcome.differing == 2
    assert "verdict OPEN recorded, OK now" in outcome.first_differing[0]
    assert "reconstructor 0000000000000007 recorded" in outcome.first_differing[1]


@pytest.mark.parametrize("bit", [0, 13])
def test_one_flipped_bit_of_one_slope_shows_from_that_frame_on(bench, mini, tmp_path, bit):
    """The lowest bits of a slope; an even lower share of the command may round away for a while."""
    made = bench(bag=tmp_path / "bag")
    made.close(mini.a)
    made.run(range(60))
    made.finish()

    def flip(topic, data):
        if topic == wire.SLOPES.name:
            message = wire.read_slope_frame(data)
            if (message.frame, message.sensor) == (20, 1):
                data = bytearray(data)
                data[len(data) - 4 * 30 + bit // 8] ^= 1 << bit % 8
        return bytes(data)

    outcome = replay(rewrite(tmp_path / "bag", tmp_path / "flipped", flip))
    assert outcome.compared == 60
    assert outcome.first_differing[0].startswith("frame 20:")
    assert outcome.differing == 40 or (bit == 0 and 5 < outcome.differing <= 40)


def test_an_event_that_is_late_in_the_bag_is_replayed_at_its_frame(eventful, tmp_path):
    """Events are published up to 100 ms after the frame that they name."""
    with BagReader(eventful[0]) as reader:
        messages = list(reader.messages())
        metadata = reader.metadata
    with BagWriter(tmp_path / "late", metadata) as writer:
        for message in messages:
            late = 40_000_000 if message.topic == "/hrtc/event" else 0
            writer.write(message.topic, message.type, message.data, message.log_time + late, 0)
    assert clean(replay(tmp_path / "late"))


def test_events_that_change_no_command_do_not_delay_those_that_do(eventful, tmp_path):
    """STAGED and REFUSED name a frame too, but another thread says so: they may stand before earlier frames' events."""

    with BagReader(eventful[0]) as reader, BagWriter(tmp_path / "more", reader.metadata) as writer:
        for message in reader.messages():
            if message.topic == "/hrtc/event":
                event = decode(message.type, message.data)
                for kind in (EventKind.STAGED, EventKind.REFUSED, EventKind.LIFECYCLE):
                    ahead = {"session": event.session, "first_frame": event.first_frame + 15, "kind": int(kind)}
                    writer.write(message.topic, message.type, encode(message.type, **ahead), message.log_time - 1, 0)
            writer.write(message.topic, message.type, message.data, message.log_time, 0)
    assert clean(replay(tmp_path / "more"))


def test_a_cut_bag_replays_up_to_its_end(eventful, tmp_path):
    path, _ = eventful
    rewritten = tmp_path / "flushed"
    with BagReader(path) as reader, BagWriter(rewritten, reader.metadata) as writer:
        for i, message in enumerate(reader.messages()):
            writer.write(message.topic, message.type, message.data, message.log_time, 0)
            if i % 100 == 99:
                writer.flush()
    (file,) = rewritten.glob("*.mcap")
    whole = file.read_bytes()
    file.write_bytes(whole[: int(0.85 * len(whole))])
    with BagReader(rewritten) as reader:
        assert reader.cut is not None
    outcome = replay(rewritten)
    assert (outcome.differing, outcome.skipped, outcome.gaps) == (0, 0, [])
    assert 50 < outcome.compared < 200 and outcome.first_frame == 0


# -- what the recording lost -----------------------------------------------------------------------------------------


def without(frames, *topics):
    return lambda topic, data: None if topic in topics and frame_of(topic, data) in frames else data


def test_lost_slopes_are_said_and_the_replay_goes_on_at_the_next_state(eventful, tmp_path):
    outcome = replay(rewrite(eventful[0], tmp_path / "lost", without({85}, wire.SLOPES.name)))
    assert outcome.gaps == ["Slopes of frame 85 are not in the bag."]
    assert (outcome.differing, outcome.skipped, outcome.compared) == (0, 16, 184)  # on from the state after 100


def test_lost_slopes_of_one_sensor(eventful, tmp_path):
    def lose(topic, data):
        lost = topic == wire.SLOPES.name and frame_of(topic, data) == 85 and wire.read_slope_frame(data).sensor == 3
        return None if lost else data

    outcome = replay(rewrite(eventful[0], tmp_path / "lost", lose))
    assert (outcome.differing, outcome.skipped, len(outcome.gaps)) == (0, 16, 1)


def test_lost_slopes_that_were_not_used_do_not_matter(eventful, tmp_path):
    """Of a held frame, and of an open loop."""
    outcome = replay(rewrite(eventful[0], tmp_path / "lost", without({5, 30, 40, 135}, wire.SLOPES.name)))
    assert clean(outcome) and outcome.compared == 200


def test_a_lost_command_leaves_the_loop_unknown(eventful, tmp_path):
    outcome = replay(rewrite(eventful[0], tmp_path / "lost", without({85}, wire.COMMAND.name)))
    assert outcome.gaps == ["The answer to frame 85 is not in the bag."]
    assert (outcome.unanswered, outcome.differing, outcome.skipped, outcome.compared) == (1, 0, 15, 184)


def test_a_lost_reconstructor_is_said_and_can_be_supplied(eventful, mini, tmp_path):
    def lose(topic, data):
        if topic == wire.RECONSTRUCTOR_BLOCK.name:
            block = wire.read_block(data)
            return None if (block.id, block.number) == (mini.c.id, 3) else data
        return data

    path = rewrite(eventful[0], tmp_path / "lost", lose)
    outcome = replay(path)
    assert f"Reconstructor {mini.c.id:016x}, in use at frame 81, is not in the bag." in outcome.gaps
    assert outcome.differing == 0 and outcome.compared == 200 - outcome.skipped < 190
    assert clean(replay(path, supplied=[mini.c]))


def test_a_reconstructor_that_is_not_what_its_checksum_says_is_not_used(eventful, mini, tmp_path):
    def damage(topic, data):
        if topic == wire.RECONSTRUCTOR_BLOCK.name and wire.read_block(data).id == mini.c.id:
            data = data[:-1] + bytes([data[-1] ^ 1])
        return data

    outcome = replay(rewrite(eventful[0], tmp_path / "damaged", damage))
    assert outcome.differing == 0 and any("is not in the bag" in gap for gap in outcome.gaps)


def test_garbage_beside_the_loop_is_passed_over(eventful, tmp_path):
    """What the HRTC dropped does not disturb the replay either."""
    path, made = eventful
    with BagReader(path) as reader, BagWriter(tmp_path / "more", reader.metadata) as writer:
        for i, message in enumerate(reader.messages()):
            topic, kind, time = message.topic, message.type, message.log_time
            writer.write(topic, kind, message.data, time, 0)
            if topic == "/wfs/slopes":
                writer.write(topic, kind, message.data, time, 0)  # a duplicate
                writer.write(topic, kind, message.data[: i % len(message.data)], time, 0)
                k = wire.read_slope_frame(message.data).frame
                other = made.messages(k, np.ones(made.layout.n_slopes), session=99)
                stray = made.messages(2**62, np.ones(made.layout.n_slopes))
                alien = made.messages(k, np.ones(made.layout.n_slopes), fingerprint=bytes(32))
                for data in (other[0], stray[0], alien[0], made.packet(k, 0, 3, 4, slopes=np.ones(1000))):
                    writer.write(topic, kind, data, time, 0)
            if topic == "/srtc/reconstructor_block":
                writer.write(topic, kind, message.data[:-5], time, 0)
    assert clean(replay(tmp_path / "more"))


# -- sessions --------------------------------------------------------------------------------------------------------


def test_sessions_one_after_the_other_and_back(bench, mini, tmp_path):
    """A swap under one session is in force in the next, also when that is an earlier one again."""
    made = bench(bag=tmp_path / "bag")
    made.close(mini.a)
    made.run(range(20))
    first, made.session = made.session, 99
    made.now += 2 * SECOND
    made.sky.shown.clear()
    made.run(range(5, 10))
    made.publish(mini.c)
    made.commit(mini.c)
    made.hrtc.loop.request(closed=True)
    made.run(range(10, 30))
    made.now += 2 * SECOND
    made.session = first
    made.sky.shown.clear()
    made.hrtc.loop.request(closed=True)
    made.run(range(2000, 2020))
    made.now += 2 * SECOND
    made.swap.change_settings(leak=0.05)
    made.run(range(10**12, 10**12 + 20))
    made.finish()
    outcome = replay(tmp_path / "bag")
    assert clean(outcome), asdict(outcome)
    assert outcome.compared == 20 + 25 + 20 + 20


def test_a_restarted_hrtc(bench, mini, tmp_path):
    """Another process takes over the same session: it starts at zero, without a reconstructor."""
    made = bench(bag=tmp_path / "bag")
    made.close(mini.a)
    made.run(range(20))
    made.configure()
    for k in range(20, 40):  # nobody answers
        for message in made.messages(k):
            made._record(wire.SLOPES, message)
    made.run(range(40, 50))
    made.swap.stage_whole(mini.c)
    made.close(mini.c)
    made.run(range(50, 60))
    made.finish()
    outcome = replay(tmp_path / "bag")
    assert (outcome.compared, outcome.differing, outcome.skipped, outcome.gaps) == (40, 0, 0, [])
    assert outcome.unanswered == 20


def test_deactivated_and_activated(bench, mini, tmp_path):
    """The flat is replayed although the slopes of its frame came; what was not answered is not missed."""
    made = bench(bag=tmp_path / "bag")
    made.close(mini.a)
    made.run(range(20))
    made.hrtc.flatten()
    made.offer(*made.messages(20))
    made.hrtc.start()
    made.run(range(40, 60))
    made.hrtc.loop.request(closed=True)
    made.run(range(60, 80))
    made.finish()
    outcome = replay(tmp_path / "bag")
    assert clean(outcome), asdict(outcome)
    assert outcome.compared == 61


def test_a_closing_before_the_first_slopes(bench, mini, tmp_path):
    made = bench(bag=tmp_path / "bag")
    made.close(mini.a)
    made.hrtc.idle(made.now)
    made.tell()
    made.run(range(1000, 1010))
    made.finish()
    outcome = replay(tmp_path / "bag")
    assert clean(outcome) and outcome.compared == 10


def test_packets_and_combined_messages_replay(bench, mini, tmp_path):
    made = bench(bag=tmp_path / "bag")
    made.close(mini.a)
    n = made.layout.sensors[0].n_valid
    for k in range(30):
        made.offer(made.packet(k, 0, n // 2, n - n // 2), made.packet(k, 1, 0, 0, 3), made.packet(k, 0, 0, n // 2))
    made.finish()
    outcome = replay(tmp_path / "bag")
    assert clean(outcome) and outcome.compared == 30
    assert all(command.verdict == Verdict.OK for command in made.commands)


# -- what cannot be replayed -----------------------------------------------------------------------------------------


def test_bags_that_cannot_be_replayed(eventful, mini, tmp_path):
    with BagReader(eventful[0]) as reader:
        metadata = reader.metadata
    with BagWriter(tmp_path / "empty", metadata):
        pass
    with pytest.raises(BagError, match="no slopes or no commands"):
        replay(tmp_path / "empty")
    with BagWriter(tmp_path / "foreign", {}):
        pass
    with pytest.raises(BagError, match="which instrument"):
        replay(tmp_path / "foreign")

    def other_kernel(topic, data):
        if topic == wire.EVENT.name:
            event = decode(wire.EVENT.type, data)
            fields = {"kind": event.kind, "session": event.session, "kernel": "another-1"}
            data = encode(wire.EVENT.type, **fields)
        return data

    with pytest.raises(BagError, match="kernel another-1"):
        replay(rewrite(eventful[0], tmp_path / "kernel", other_kernel))

    def no_beginning(topic, data):
        return None if topic in (wire.EVENT.name, wire.STATE.name) else data

    with pytest.raises(BagError, match="no frame could be compared"):
        replay(rewrite(eventful[0], tmp_path / "nothing", no_beginning))
    with pytest.raises(BagError, match="no frame could be compared"):
        replay(eventful[0], 10**6)


def test_event_kinds_are_those_of_the_message():
    text = definition(wire.EVENT.type)
    assert all(f"uint8 {kind.name}={int(kind)} " in text for kind in EventKind)
    assert all(f"uint8 {verdict.name}={int(verdict)} " in definition(wire.COMMAND.type) for verdict in Verdict)
