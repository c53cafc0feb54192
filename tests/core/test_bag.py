"""Bags, held against two readers that are not ours: rosbags and mcap with its ROS 2 decoder."""

import gc
import random
import resource
from pathlib import Path

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, IndexType, Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter

from srtomo_core import bag as bag_module
from srtomo_core import wire
from srtomo_core.bag import BagError, BagReader, BagWriter, repair
from srtomo_core.messages import definition, encode, typestore

START = 1_700_000_000_000_000_000
SLOPES = "/gnao/wfs/slopes"
EVENTS = "/gnao/hrtc/event"


def slope_frame(frame: int) -> bytes:
    slopes = np.random.default_rng(frame).normal(size=40)
    return encode(wire.SLOPES.type, frame=frame, session=1, n_sensors=1, n_subapertures=20, slopes=slopes)


def event(text: str) -> bytes:
    return encode(wire.EVENT.type, kind=3, text=text, offset=[1.0, 2.0, 3.0], header={"frame_id": "hrtc"})


@pytest.fixture
def small_chunks(monkeypatch):
    monkeypatch.setattr(bag_module, "CHUNK_SIZE", 2000)


def write_bag(path: Path, frames: int = 60) -> Path:
    with BagWriter(path, {"fingerprint": "ab" * 32, "system": "{}"}) as writer:
        writer.declare(SLOPES, wire.SLOPES.type, depth=500)
        writer.declare(EVENTS, wire.EVENT.type, depth=256, transient_local=True)
        for frame in range(frames):
            time = START + frame * 2_000_000
            writer.write(SLOPES, wire.SLOPES.type, slope_frame(frame), time, time - 100_000, frame + 1)
            if frame % 7 == 0:
                writer.write(EVENTS, wire.EVENT.type, event(f"at {frame}"), time + 1, time)
    return path


def mcap_file(path: Path) -> Path:
    return path / f"{path.name}_0.mcap"


def cut_bag(bag: Path, size: int) -> Path:
    """Cut a bag's file to a size, as a kill does."""
    file = mcap_file(bag)
    file.write_bytes(file.read_bytes()[:size])
    return bag


def recovered_by_stream_reader(file: Path) -> list[tuple[int, bytes]]:
    """Log times and contents of the messages that mcap's own stream reader finds before it gives up."""
    found = []
    with file.open("rb") as stream:
        try:
            for record in StreamReader(stream).records:
                if isinstance(record, Message):
                    found.append((record.log_time, record.data))
        # struct, zstd and mcap errors alike: this is where it ends
        except Exception:
            pass
    return sorted(found, key=lambda item: item[0])


def test_three_readers_agree_on_every_field(tmp_path, small_chunks):
    path = write_bag(tmp_path / "night")
    with BagReader(path) as reader:
        ours = list(reader)
        assert reader.cut is None
        assert reader.metadata == {"fingerprint": "ab" * 32, "system": "{}"}
        assert reader.topics == {SLOPES: wire.SLOPES.type, EVENTS: wire.EVENT.type}
        assert reader.counts == {SLOPES: 60, EVENTS: 9}
        assert reader.time_range == (START, START + 59 * 2_000_000)
    store = typestore()
    with AnyReader([path]) as rosbags_reader:
        assert rosbags_reader.message_count == 69
        theirs = list(rosbags_reader.messages())
        decoded = [rosbags_reader.deserialize(data, connection.msgtype) for connection, _, data in theirs]
    assert [(m.topic, m.type, m.log_time, m.data) for m in ours] == [
        (connection.topic, connection.msgtype, time, bytes(data)) for connection, time, data in theirs
    ]
    with mcap_file(path).open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        through_mcap = list(reader.iter_decoded_messages())
    for own, their, (_, channel, message, third) in zip(ours, decoded, through_mcap, strict=True):
        mine = store.deserialize_cdr(own.data, own.type)
        assert (message.log_time, channel.topic) == (own.log_time, own.topic)
        for name in ("frame", "slopes") if own.topic == SLOPES else ("kind", "text", "offset"):
            np.testing.assert_array_equal(getattr(mine, name), getattr(their, name))
            np.testing.assert_array_equal(getattr(mine, name), getattr(third, name))
        assert mine.header.frame_id == their.header.frame_id == third.header.frame_id


def test_metadata_yaml_is_there_from_the_start_and_right_at_the_end(tmp_path):
    writer = BagWriter(tmp_path / "night", {})
    early = yaml.safe_load((tmp_path / "night" / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert (early["version"], early["storage_identifier"], early["message_count"]) == (9, "mcap", 0)
    writer.declare(EVENTS, wire.EVENT.type, depth=256, transient_local=True)
    writer.write(EVENTS, wire.EVENT.type, event("x"), START, START)
    writer.close()
    late = yaml.safe_load((tmp_path / "night" / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    (topic,) = late["topics_with_message_count"]
    assert (late["message_count"], topic["message_count"], topic["topic_metadata"]["name"]) == (1, 1, EVENTS)
    assert topic["topic_metadata"]["offered_qos_profiles"][0]["durability"] == "transient_local"
    assert [path.name for path in (tmp_path / "night").iterdir() if path.suffix == ".part"] == []


def test_an_empty_bag_opens_everywhere(tmp_path):
    path = tmp_path / "night"
    BagWriter(path, {"a": "b"}).close()
    with BagReader(path) as reader:
        assert (list(reader), reader.cut, reader.metadata) == ([], None, {"a": "b"})
    with AnyReader([path], default_typestore=typestore()) as rosbags_reader:
        assert rosbags_reader.message_count == 0


def test_messages_come_in_the_order_of_their_log_times(tmp_path, small_chunks):
    times = list(range(START, START + 200))
    shuffled = times.copy()
    random.Random(3).shuffle(shuffled)
    for name, order in ("nearly", [t ^ 3 for t in times]), ("wild", shuffled), ("equal", [START] * 200):
        with BagWriter(tmp_path / name, {}) as writer:
            for count, time in enumerate(order):
                writer.write(SLOPES, wire.SLOPES.type, slope_frame(count), time, time)
        with BagReader(tmp_path / name) as reader:
            frames = [wire.read_slope_frame(m.data).frame for m in reader]
            assert frames == sorted(range(200), key=order.__getitem__)  # stable: the file's order among equals


def test_only_some_topics(tmp_path, small_chunks):
    with BagReader(write_bag(tmp_path / "night")) as reader:
        assert {m.topic for m in reader.messages(EVENTS)} == {EVENTS}
        assert len(list(reader.messages(EVENTS))) == 9
        assert len(list(reader.messages(EVENTS, SLOPES))) == 69
        # two iterations at once do not disturb each other
        pairs = list(zip(reader.messages(SLOPES), reader.messages(SLOPES)))
        assert len(pairs) == 60 and all(a == b for a, b in pairs)


def test_topics_are_found_by_their_relative_names(tmp_path):
    with BagWriter(tmp_path / "night", {}) as writer:
        for topic in ("/a/hrtc/event", "/b/hrtc/event", "/a/xhrtc/state", "/a/hrtc/state", "/event"):
            writer.declare(topic, wire.EVENT.type)
            writer.write(topic, wire.EVENT.type, event(topic), START, START)
    with BagReader(tmp_path / "night") as reader:
        assert reader.topic("hrtc/state") == "/a/hrtc/state"
        assert reader.topic("/b/hrtc/event") == "/b/hrtc/event"
        with pytest.raises(BagError, match="several namespaces: /a/hrtc/event, /b/hrtc/event"):
            reader.topic("hrtc/event")
        with pytest.raises(BagError, match="no topic hrtc/command"):
            reader.topic("hrtc/command")
        with pytest.raises(BagError, match="no topic /hrtc/state"):
            reader.topic("/hrtc/state")


def test_every_whole_record_of_a_cut_bag_is_recovered(tmp_path, small_chunks):
    path = write_bag(tmp_path / "night", frames=40)
    whole = mcap_file(path).read_bytes()
    offsets = {*random.Random(1).sample(range(8, len(whole)), 80), *range(len(whole) - 40, len(whole))}
    seen = set()
    for size in sorted(offsets):
        mcap_file(path).write_bytes(whole[:size])
        expected = recovered_by_stream_reader(mcap_file(path))
        with BagReader(path) as reader:
            assert [(m.log_time, m.data) for m in reader] == expected, size
            assert reader.message_count == len(expected)
            assert reader.cut is not None and f"of {size} bytes" in reader.cut
            assert f"hold {len(expected)} messages" in reader.cut
        seen.add(len(expected))
    assert {0, 46} < seen  # from nothing to everything, and something between


def test_a_repaired_bag_opens_in_every_reader(tmp_path, small_chunks):
    path = write_bag(tmp_path / "night")
    cut_bag(path, mcap_file(path).stat().st_size * 2 // 3)
    before = mcap_file(path).read_bytes()
    expected = recovered_by_stream_reader(mcap_file(path))
    assert 0 < len(expected) < 69
    assert repair(path, tmp_path / "mended") == len(expected)
    assert mcap_file(path).read_bytes() == before
    with BagReader(tmp_path / "mended") as reader:
        assert reader.cut is None
        assert reader.metadata["fingerprint"] == "ab" * 32
        assert [(m.log_time, m.data) for m in reader] == expected
    with AnyReader([tmp_path / "mended"]) as rosbags_reader:
        assert [bytes(data) for _, _, data in rosbags_reader.messages()] == [data for _, data in expected]
        qos = {c.topic: c.ext.offered_qos_profiles[0].durability.name for c in rosbags_reader.connections}
        assert qos == {SLOPES: "VOLATILE", EVENTS: "TRANSIENT_LOCAL"}
    with mcap_file(tmp_path / "mended").open("rb") as stream:
        messages = [message for _, _, message in make_reader(stream).iter_messages(topics=[SLOPES])]
    assert [message.publish_time - START for message in messages[:2]] == [-100_000, 1_900_000]
    assert [message.sequence for message in messages[:3]] == [1, 2, 3]


def test_a_repair_that_is_not_needed_or_not_possible_is_refused(tmp_path):
    path = write_bag(tmp_path / "night")
    with pytest.raises(BagError, match="whole, with 69 messages: nothing to repair"):
        repair(path, tmp_path / "mended")
    cut_bag(path, 300)
    with pytest.raises(BagError, match="nothing to recover"):
        repair(path, tmp_path / "mended")
    assert not (tmp_path / "mended").exists()


def test_a_tail_of_zeros_is_no_record(tmp_path, small_chunks):
    path = write_bag(tmp_path / "night")
    data = bytearray(mcap_file(path).read_bytes())
    half = len(data) // 2
    data[half:] = bytes(len(data) - half)
    mcap_file(path).write_bytes(data)
    with BagReader(path) as reader:
        assert 0 < len(list(reader)) == reader.message_count < 69
        assert reader.cut is not None
    assert repair(path, tmp_path / "mended") > 0


def test_a_damaged_chunk_is_not_read_over(tmp_path, small_chunks):
    path = write_bag(tmp_path / "night")
    data = bytearray(mcap_file(path).read_bytes())
    data[len(data) // 3] ^= 0x10
    mcap_file(path).write_bytes(data)
    with BagReader(path) as reader, pytest.raises(BagError, match="damaged at byte"):
        list(reader)


def test_no_flipped_bit_leads_to_anything_but_a_bag_error_or_the_same_messages(tmp_path, small_chunks):
    path = write_bag(tmp_path / "night", frames=20)
    whole = mcap_file(path).read_bytes()
    with BagReader(path) as reader:
        expected = [message.data for message in reader.messages(SLOPES)]
    chance = random.Random(5)
    refused = 0
    for _ in range(400):
        data = bytearray(whole)
        data[chance.randrange(8, len(whole))] ^= 1 << chance.randrange(8)
        mcap_file(path).write_bytes(data)
        try:
            with BagReader(path) as reader:
                found = [message.data for message in reader.messages(SLOPES)]
        except BagError as error:
            assert "\n" not in str(error)
            refused += 1
        else:
            assert found == expected or reader.cut is not None or SLOPES not in reader.topics
    assert refused > 100


def test_bags_of_other_writers(tmp_path):
    with RosbagsWriter(tmp_path / "rosbags", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection(SLOPES, wire.SLOPES.type, typestore=typestore())
        for frame in range(30):
            writer.write(connection, START + frame, slope_frame(frame))
    for name, options in {
        "without_chunks": {"use_chunking": False},
        "without_index": {"index_types": IndexType.NONE, "chunk_size": 500, "repeat_channels": False},
        "lz4": {"compression": CompressionType.LZ4, "use_statistics": False, "repeat_schemas": False},
    }.items():
        with (tmp_path / f"{name}.mcap").open("wb") as stream:
            writer = Writer(stream, **options)
            writer.start(profile="ros2")
            schema = writer.register_schema(wire.SLOPES.type, "ros2msg", definition(wire.SLOPES.type).encode())
            channel = writer.register_channel(SLOPES, "cdr", schema)
            for frame in range(30):
                writer.add_message(channel, START + frame, slope_frame(frame), START)
            writer.finish()
    for path in ("rosbags", "without_chunks.mcap", "without_index.mcap", "lz4.mcap"):
        with BagReader(tmp_path / path) as reader:
            assert (reader.cut, reader.counts, reader.metadata) == (None, {SLOPES: 30}, {}), path
            assert [m.data for m in reader] == [slope_frame(frame) for frame in range(30)], path
            assert reader.time_range == (START, START + 29), path


def test_what_is_no_bag_is_refused_in_one_line(tmp_path):
    (tmp_path / "text.mcap").write_text("not a bag at all")
    (tmp_path / "empty").mkdir()
    for path, news in (
        ("text.mcap", "not an MCAP file"),
        ("empty", "expected a directory with .mcap files, got none"),
        ("nowhere", "No such file"),
    ):
        with pytest.raises(BagError, match=news) as caught:
            BagReader(tmp_path / path)
        assert "\n" not in str(caught.value)


def test_a_bag_is_not_overwritten(tmp_path):
    path = write_bag(tmp_path / "night")
    before = mcap_file(path).read_bytes()
    with pytest.raises(BagError, match="exists already"):
        BagWriter(path, {})
    assert mcap_file(path).read_bytes() == before


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(BagError, match="file/night: cannot be written"):
        BagWriter(tmp_path / "file" / "night", {})


def test_a_topic_keeps_its_type(tmp_path):
    with BagWriter(tmp_path / "night", {}) as writer:
        writer.write(EVENTS, wire.EVENT.type, event("x"), START, START)
        with pytest.raises(BagError, match="holds msgs_schema/msg/HrtcEvent"):
            writer.write(EVENTS, wire.STATUS.type, b"", START, START)


@pytest.fixture
def file_size_limit():
    """No file of this process may grow beyond 100 kB: what a full disk is like."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_full_disk_leaves_what_was_written(tmp_path, small_chunks, file_size_limit):
    writer = BagWriter(tmp_path / "night", {})
    with pytest.raises(BagError, match="night: cannot be written") as caught:
        for frame in range(5000):
            writer.write(SLOPES, wire.SLOPES.type, slope_frame(frame), START + frame, START)
    assert "\n" not in str(caught.value)
    with BagReader(tmp_path / "night") as reader:
        assert reader.cut is not None
        frames = [wire.read_slope_frame(m.data).frame for m in reader]
    assert frames == list(range(len(frames))) and len(frames) > 100


def write_split(path: Path, frames: int, **limits: int) -> BagWriter:
    """Slopes, flushed every 20 frames, and an event that begins every 50."""
    with BagWriter(path, {"system": "{}"}, **limits) as writer:
        writer.declare(SLOPES, wire.SLOPES.type, depth=500)
        writer.declare(EVENTS, wire.EVENT.type, depth=2, transient_local=True)
        for frame in range(frames):
            time = START + frame * 2_000_000
            if frame % 50 == 0:
                writer.write(EVENTS, wire.EVENT.type, event(f"at {frame}"), time - 1, time)
            writer.write(SLOPES, wire.SLOPES.type, slope_frame(frame), time, time, frame + 1)
            if frame % 20 == 19:
                writer.flush()
    return writer


def frames_of(path: Path) -> list[int]:
    with BagReader(path) as reader:
        assert reader.cut is None
        return [wire.read_slope_frame(m.data).frame for m in reader.messages(SLOPES)]


def test_a_split_bag_reads_as_one(tmp_path, small_chunks):
    path = tmp_path / "night"
    write_split(path, 500, split_bytes=20_000)
    files = sorted(path.glob("*.mcap"))
    assert len(files) > 4 and all(20_000 <= file.stat().st_size < 40_000 for file in files[:-1])
    assert frames_of(path) == list(range(500))
    write_split(tmp_path / "one", 500)
    with BagReader(path) as split, BagReader(tmp_path / "one") as one:
        assert list(split) == list(one)
        assert (split.counts, split.time_range, split.metadata) == (one.counts, one.time_range, one.metadata)
    with AnyReader([path]) as theirs:  # which is also shown what every file repeats for late readers
        found = [bytes(data) for connection, _, data in theirs.messages() if connection.topic == SLOPES]
    assert found == [slope_frame(frame) for frame in range(500)]


def test_a_limit_removes_the_oldest_and_leaves_what_a_late_reader_needs(tmp_path, small_chunks):
    path = tmp_path / "night"
    writer = write_split(path, 1000, split_bytes=20_000, limit_bytes=100_000)
    files = sorted(path.glob("*.mcap"))
    assert sum(file.stat().st_size for file in files) <= 100_000
    assert writer.removed_files > 5 and not (path / "night_0.mcap").exists()
    frames = frames_of(path)
    assert frames == list(range(frames[0], 1000)) and len(frames) > 100
    with BagReader(path) as reader:
        texts = [typestore().deserialize_cdr(m.data, m.type).text for m in reader.messages(EVENTS)]
    before = (frames[0] - 1) // 50 * 50
    assert texts == [f"at {frame}" for frame in range(before - 50, 1000, 50)]
    information = yaml.safe_load((path / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert sorted(information["relative_file_paths"]) == [file.name for file in files]


def test_finished_files_may_be_deleted_meanwhile(tmp_path, small_chunks):
    """Somebody else makes room: the recording goes on, counts what it wrote, and keeps within its limit."""
    path = tmp_path / "night"
    with BagWriter(path, {}, split_bytes=20_000, limit_bytes=60_000) as writer:
        for frame in range(600):
            writer.write(SLOPES, wire.SLOPES.type, slope_frame(frame), START + frame, START + frame)
            if frame % 20 == 19:
                writer.flush()
            if frame == 200:
                written = writer.bytes_written
                (path / f"night_{writer.removed_files}.mcap").unlink()
                assert writer.bytes_written == written
    assert writer.removed_files > 2
    assert frames_of(path)[-1] == 599


def test_a_recording_without_an_end_keeps_no_index_of_finished_files(tmp_path, small_chunks):
    with BagWriter(tmp_path / "night", {}, split_bytes=5000) as writer:
        for frame in range(200):
            writer.write(SLOPES, wire.SLOPES.type, slope_frame(frame), START + frame, START + frame)
            writer.flush()
        gc.collect()
        indices = sum(isinstance(one, Writer) for one in gc.get_objects())
    assert len(list((tmp_path / "night").glob("*.mcap"))) > 10
    assert indices == 1


def test_later_files_repeat_no_more_than_asked_for(tmp_path, small_chunks):
    with BagWriter(tmp_path / "night", {}, split_bytes=1000) as writer:
        writer.declare(EVENTS, wire.EVENT.type, depth=4096, transient_local=True)
        for number in range(40):
            writer.write(EVENTS, wire.EVENT.type, event(str(number)), START + number, START + number)
        writer.keep(EVENTS, 3)
        writer.keep("/unknown", 3)
        writer.flush()
    with BagReader(tmp_path / "night" / "night_1.mcap") as second:
        texts = [typestore().deserialize_cdr(m.data, m.type).text for m in second]
    assert texts == ["37", "38", "39"]


def test_a_split_bag_that_was_cut_is_mended_whole(tmp_path, small_chunks):
    path = tmp_path / "night"
    write_split(path, 300, split_bytes=20_000)
    last = max(path.glob("*.mcap"), key=lambda file: int(file.stem.rpartition("_")[2]))
    last.write_bytes(last.read_bytes()[:-500])
    with BagReader(path) as reader:
        assert reader.cut is not None and reader.cut.startswith(last.name)
        expected = list(reader)
    assert repair(path, tmp_path / "mended") == len(expected)
    with BagReader(tmp_path / "mended") as reader:
        assert list(reader) == expected


def test_a_limit_below_two_files_is_refused(tmp_path):
    with pytest.raises(ValueError, match="at least two files"):
        BagWriter(tmp_path / "night", {}, split_bytes=100, limit_bytes=150)
    with pytest.raises(ValueError, match="expected files to be split"):
        BagWriter(tmp_path / "night", {}, limit_bytes=150)
    with pytest.raises(ValueError, match="expected a size above 0"):
        BagWriter(tmp_path / "night", {}, split_bytes=0)
    assert not (tmp_path / "night").exists()
