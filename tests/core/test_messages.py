import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from srtomo_core import wire
from srtomo_core.messages import MessageError, decode, decode_recorded, definition, encode, message_types


def test_every_topic_of_the_wire_has_a_definition():
    for topic in wire.TOPICS:
        assert "float32[] " in definition(topic.type) or "\nMSG: std_msgs/Header\n" in definition(topic.type)


def test_definition_keeps_our_comments_and_holds_every_part():
    text = definition(wire.SLOPES.type)
    assert text.startswith(message_types()[wire.SLOPES.type].rstrip())
    assert "rad of wavefront tilt" in text
    assert [line for line in text.splitlines() if line.startswith("MSG: ")] == [
        "MSG: std_msgs/Header",
        "MSG: builtin_interfaces/Time",
    ]


def test_encode_agrees_with_the_views_of_the_wire():
    slopes = np.linspace(-1, 1, 8, dtype=np.float32)
    buffer = encode(
        wire.SLOPES.type,
        header={"stamp": {"sec": 7, "nanosec": 8}, "frame_id": "lgs"},
        session=2**63 + 1,
        frame=5,
        fingerprint=bytes(range(32)),
        sensor=2,
        n_sensors=1,
        n_subapertures=4,
        mirror_frame=wire.MIRROR_UNKNOWN,
        mirror_fraction=0.25,
        slopes=slopes,
    )
    frame = wire.read_slope_frame(buffer)
    assert (frame.stamp_sec, frame.stamp_nanosec, frame.session, frame.frame) == (7, 8, 2**63 + 1, 5)
    assert frame.fingerprint == bytes(range(32))
    assert (frame.sensor, frame.mirror_frame, frame.mirror_fraction) == (2, wire.MIRROR_UNKNOWN, 0.25)
    np.testing.assert_array_equal(frame.slopes, slopes)


def test_decode_reads_what_the_wire_writes():
    writer = wire.SlopeFrameWriter("ngs", session=3, fingerprint=bytes(32), sensor=1, n_sensors=1, n_subapertures=2)
    writer.values[:] = [1, 2, 3, 4]
    message = decode(wire.SLOPES.type, writer.write(1_500_000_000, 9, 7, 6, 0.5))
    assert message.header.frame_id == "ngs"
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1, 500_000_000)
    assert (message.session, message.frame, message.mirror_frame, message.mirror_frame_before) == (3, 9, 7, 6)
    np.testing.assert_array_equal(message.slopes, [1, 2, 3, 4])


def test_nested_sequences():
    values = [{"key": "rate", "value": "500"}]
    buffer = encode("diagnostic_msgs/msg/DiagnosticArray", status=[{"name": "loop", "level": 1, "values": values}])
    (status,) = decode("diagnostic_msgs/msg/DiagnosticArray", buffer).status
    assert (status.name, status.level, status.values[0].key, status.values[0].value) == ("loop", 1, "rate", "500")


@pytest.mark.parametrize(
    ("call", "news"),
    [
        (lambda: encode("msgs_schema/msg/Nothing"), "no such message type"),
        (lambda: encode(wire.EVENT.type, knd=3), "no field knd"),
        (lambda: encode(wire.EVENT.type, sha256=bytes(31)), "HrtcEvent"),
        (lambda: encode(wire.EVENT.type, kind=300), "HrtcEvent"),
        (lambda: decode(wire.EVENT.type, bytes(10)), "10 bytes are no"),
    ],
)
def test_what_is_no_message_is_refused_in_one_line(call, news):
    with pytest.raises(MessageError, match=news) as caught:
        call()
    assert "\n" not in str(caught.value)


def test_a_message_of_an_older_definition_lacks_what_is_new():
    """Fields added since, at the end or before it, are zero or empty."""
    text = definition(wire.EVENT.type)
    older = [
        line
        for line in text.splitlines()
        if not line.startswith(("float32 watchdog", "uint32 gain_ramp", "string kernel"))
    ]
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg("\n".join(older), wire.EVENT.type))
    new = decode(wire.EVENT.type, encode(wire.EVENT.type, kind=2, offset=[1, 2], slew_limit=3.0))
    fields = {name: value for name, value in vars(new).items() if name not in ("watchdog", "gain_ramp", "kernel")}
    data = bytes(store.serialize_cdr(store.types[wire.EVENT.type](**fields), wire.EVENT.type))
    read = decode_recorded(wire.EVENT.type, data, "\n".join(older))
    assert (read.kind, read.offset.tolist(), read.slew_limit) == (2, [1.0, 2.0], 3.0)
    assert (read.watchdog, read.gain_ramp, read.kernel) == (0, 0, "")
    with pytest.raises(MessageError, match="as recorded"):
        decode_recorded(wire.EVENT.type, data[:50], "\n".join(older))
    with pytest.raises(MessageError, match="as recorded"):
        decode_recorded(wire.EVENT.type, data, "no definition")
