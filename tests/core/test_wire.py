"""The hot messages against another implementation of CDR, their lengths, and the table of topics."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from srtomo_core import wire
from srtomo_core.messages import decode, encode, message_types
from srtomo_core.reconstructor import block_table
from srtomo_core.wire import WireError

U64, I64 = st.integers(0, 2**64 - 1), st.integers(-(2**63), 2**63 - 1)
U32, U16, U8 = st.integers(0, 2**32 - 1), st.integers(0, 2**16 - 1), st.integers(0, 255)
F32 = st.floats(width=32, allow_nan=False)
NAME = st.text(st.characters(codec="ascii", exclude_characters="\0"), max_size=12)
DIGEST = st.binary(min_size=32, max_size=32)
FLOATS = st.lists(st.floats(width=32), max_size=40)
QUICK = settings(max_examples=60, deadline=None)


def same_bits(a, b) -> bool:
    return np.asarray(a, "<f4").tobytes() == np.asarray(b, "<f4").tobytes()


# -- read what another implementation wrote --------------------------------------------------------------------------


@QUICK
@given(
    NAME, st.integers(0, 2**31 - 1), U32, U64, U64, DIGEST, U16, U16, U16, st.integers(0, 20), I64, I64, F32, st.data()
)
def test_slope_frames_that_others_write(
    name, sec, nanosec, session, frame, digest, sensor, n_sensors, first, n, on, before, share, data
):
    slopes = data.draw(st.lists(st.floats(width=32), min_size=2 * n, max_size=2 * n))
    buffer = encode(
        wire.SLOPES.type, header={"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": name}, session=session,
        frame=frame, fingerprint=np.frombuffer(digest, np.uint8), sensor=sensor, n_sensors=n_sensors,
        first_subaperture=first, n_subapertures=n, mirror_frame=on, mirror_frame_before=before, mirror_fraction=share,
        slopes=np.array(slopes, "f4"),
    )  # fmt: skip
    read = wire.read_slope_frame(buffer)
    assert read[:-1] == (sec, nanosec, session, frame, digest, sensor, n_sensors, first, n, on, before, share)
    assert same_bits(read.slopes, slopes)
    assert not read.slopes.flags.writeable


@QUICK
@given(NAME, U32, st.tuples(U64, U64, U64, U32, U32, U8, U8, U16, F32, I64, I64, I64, F32, F32), FLOATS)
def test_commands_that_others_write(name, nanosec, fields, commands):
    names = wire.DmCommand._fields[2:-1]
    buffer = encode(
        wire.COMMAND.type,
        header={"stamp": {"sec": 5, "nanosec": nanosec}, "frame_id": name},
        **dict(zip(names, fields, strict=True)),
        commands=np.array(commands, "f4"),
    )
    read = wire.read_dm_command(buffer)
    assert read[:-1] == (5, nanosec, *fields)
    assert same_bits(read.commands, commands)


@QUICK
@given(U64, DIGEST, U32, U32, U8, U32, st.integers(0, 5), st.integers(1, 7))
def test_blocks_that_others_write(identity, digest, number, epoch, matrix, first_row, n_rows, n_columns):
    rows = np.random.default_rng(n_rows).standard_normal((n_rows, n_columns)).astype("f4")
    fields = {"id": identity, "sha256": np.frombuffer(digest, np.uint8), "index": number, "epoch": epoch}
    shape = {"matrix": matrix, "first_row": first_row, "n_rows": n_rows, "n_columns": n_columns}
    buffer = encode(wire.RECONSTRUCTOR_BLOCK.type, **fields, **shape, data=rows.ravel())
    read = wire.read_block(buffer)
    assert read[:-1] == (identity, digest, number, epoch, matrix, first_row)
    assert np.array_equal(read.rows, rows)


# -- and the other way round -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["", "a", "lgs1", "sensor", "a longer name of a sensor"])
def test_slope_frames_for_others(name):
    writer = wire.SlopeFrameWriter(name, 2**64 - 2, bytes(range(32)), 3, 2, 5)
    writer.values[:] = np.arange(10) * 1e-7
    buffer = writer.write(1_700_000_000_123_456_789, 2**63 + 1, -1, wire.MIRROR_UNKNOWN, 0.25)
    message = decode(wire.SLOPES.type, buffer)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1_700_000_000, 123_456_789)
    assert message.header.frame_id == name
    assert (message.session, message.frame, bytes(message.fingerprint)) == (2**64 - 2, 2**63 + 1, bytes(range(32)))
    assert (message.sensor, message.n_sensors, message.first_subaperture, message.n_subapertures) == (3, 2, 0, 5)
    assert (message.mirror_frame, message.mirror_frame_before, message.mirror_fraction) == (-1, -(2**63), 0.25)
    assert same_bits(message.slopes, np.arange(10) * 1e-7)
    writer.values[:] = 0
    later = writer.write(5, 2, 1, 0, 1.0)
    assert wire.read_slope_frame(buffer).frame == 2**63 + 1  # what was written does not change any more
    assert (wire.read_slope_frame(later).frame, wire.read_slope_frame(later).stamp_nanosec) == (2, 5)


def test_commands_for_others():
    writer = wire.DmCommandWriter("dm", 7)
    writer.values[:] = np.arange(7) * 1e-8
    fields = (1, 2, 3, 4, 5, 6, 1, 8, 0.5, 7, -1, 9, 0.75, 1e-4)
    message = decode(wire.COMMAND.type, writer.write(10, 20, *fields))
    names = wire.DmCommand._fields[2:-1]
    assert tuple(getattr(message, name) for name in names) == pytest.approx(fields)
    assert (message.header.stamp.sec, message.header.stamp.nanosec, message.header.frame_id) == (10, 20, "dm")
    assert same_bits(message.commands, np.arange(7) * 1e-8)


def test_blocks_for_others():
    rows = np.random.default_rng(1).standard_normal((3, 8)).astype("f4")[:, ::2]  # not contiguous
    block = wire.ReconstructorBlock(2**63, bytes(range(32)), 4, 1, 1, 128, rows)
    message = decode(wire.RECONSTRUCTOR_BLOCK.type, wire.write_block(block))
    assert (message.id, bytes(message.sha256), message.index) == (2**63, bytes(range(32)), 4)
    assert (message.epoch, message.matrix, message.first_row) == (1, 1, 128)
    assert (message.n_rows, message.n_columns) == (3, 4)
    assert same_bits(message.data, rows.ravel())


# -- lengths ---------------------------------------------------------------------------------------------------------


def samples():
    slopes = wire.SlopeFrameWriter("s", 1, bytes(32), 0, 1, 4)
    command = wire.DmCommandWriter("dm", 5)
    block = wire.ReconstructorBlock(1, bytes(32), 0, 0, 0, 0, np.ones((2, 3), "f4"))
    return [
        (wire.read_slope_frame, slopes.write(0, 0, 0, 0, 1.0)),
        (wire.read_dm_command, command.write(0, 0, *[0] * 14)),
        (wire.read_block, wire.write_block(block)),
    ]


@pytest.mark.parametrize("read, buffer", samples(), ids=["slopes", "command", "block"])
def test_every_cut_and_every_long_tail_is_refused(read, buffer):
    read(buffer)
    for end in range(len(buffer)):
        with pytest.raises(WireError):
            read(buffer[:end])
    for more in range(1, 4):
        read(buffer + bytes(more))  # padding that some writers leave
    with pytest.raises(WireError):
        read(buffer + bytes(4))
    with pytest.raises(WireError):
        read(b"\x00\x00" + buffer[2:])  # big-endian


@pytest.mark.parametrize("read, buffer", samples(), ids=["slopes", "command", "block"])
@QUICK
@given(place=st.integers(0, 200), value=st.binary(min_size=4, max_size=4))
def test_lengths_are_not_believed(read, buffer, place, value):
    """Four bytes anywhere are overwritten, lengths among them: read in bounds, or refused."""
    place %= len(buffer) - 4
    altered = buffer[:place] + value + buffer[place + 4 :]
    try:
        message = read(altered)
    except WireError:
        return
    assert message[-1].nbytes <= len(buffer)


@QUICK
@given(st.binary(max_size=200))
def test_garbage_is_refused(data):
    for read in (wire.read_slope_frame, wire.read_dm_command, wire.read_block):
        try:
            assert read(data)[-1].nbytes <= len(data)
        except WireError as error:
            assert "\n" not in str(error)


def test_a_slope_frame_has_two_slopes_a_subaperture():
    fields = {"session": 1, "n_sensors": 1, "n_subapertures": 3}
    with pytest.raises(WireError, match="3 sub-apertures announced with 7 slopes"):
        wire.read_slope_frame(encode(wire.SLOPES.type, **fields, slopes=np.zeros(7, "f4")))


def test_a_block_has_the_announced_shape():
    with pytest.raises(WireError, match="2 x 3 announced with 5 floats"):
        wire.read_block(encode(wire.RECONSTRUCTOR_BLOCK.type, n_rows=2, n_columns=3, data=np.zeros(5, "f4")))


# -- the table of topics ---------------------------------------------------------------------------------------------


def test_every_topic_is_reliable_and_keeps_the_last():
    for topic in wire.TOPICS:
        qos = topic.qos()
        assert (qos["reliability"], qos["history"], qos["depth"]) == (1, 1, topic.depth)
        assert qos["durability"] == (1 if topic.transient_local else 2)
    assert wire.STATUS.qos(3)["depth"] == 3


def test_the_policies_are_those_of_rclpy():
    qos = pytest.importorskip("rclpy.qos", reason="needs rclpy: pip install '.[ros]', or source ROS 2 Jazzy")
    profile = qos.QoSProfile(**wire.EVENT.qos())
    assert profile.reliability == qos.ReliabilityPolicy.RELIABLE
    assert profile.durability == qos.DurabilityPolicy.TRANSIENT_LOCAL
    assert profile.history == qos.HistoryPolicy.KEEP_LAST
    assert qos.QoSProfile(**wire.SLOPES.qos()).durability == qos.DurabilityPolicy.VOLATILE


def test_names_are_relative_and_types_exist():
    assert [topic.name for topic in wire.TOPICS if topic.name.startswith("/")] == ["/diagnostics"]
    assert len({topic.name for topic in wire.TOPICS}) == len(wire.TOPICS)
    for topic in wire.TOPICS:
        assert topic.type in message_types() or not topic.type.startswith("msgs_schema")


def test_what_has_to_be_there_for_a_late_reader():
    latched = {topic.name for topic in wire.TOPICS if topic.transient_local}
    assert {"hrtc/event", "srtc/reconstructor", "srtc/reconstructor_block", "srtc/profile"} <= latched
    assert wire.RECONSTRUCTOR.depth == 1


def test_depths():
    """A second at writers and recorder, 64 elsewhere; two reconstructors' blocks, within what Fast DDS keeps."""
    assert (wire.SLOPES.depth, wire.SLOPES.depth_at(2500)) == (64, 2500)
    assert (wire.COMMAND.depth, wire.COMMAND.depth_at(0.5)) == (64, 64)
    assert wire.COMMAND.depth_at(1000.5) == 1001
    largest = block_table(5024, 8)  # of the largest instrument here, from as many exposures as a loop can use
    assert 5000 > wire.RECONSTRUCTOR_BLOCK.depth >= 2 * len(largest)
