"""The recorder as a real process, against publishers in this one."""

from __future__ import annotations

import json
import resource
import time

import numpy as np
import pytest

from srtomo_core import wire
from srtomo_core.bag import BagReader, repair
from srtomo_core.layout import Layout
from srtomo_core.messages import decode
from srtomo_core.system import load_system

rclpy = pytest.importorskip("rclpy", reason="needs rclpy: pip install '.[ros]', or source ROS 2 Jazzy")

from msgs_schema.msg import DmCommand, HrtcEvent, RecorderStatus, SlopeFrame  # noqa: E402
from rclpy.context import Context  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.qos import QoSProfile, ReliabilityPolicy  # noqa: E402

SESSION = 2**63 + 11
RATE = 500.0


class Instrument:
    """Sensors and HRTC of ``mini`` as publishers, without a sky and without a loop."""

    def __init__(self, domain: int) -> None:
        self.layout = Layout(load_system("mini"))
        self.context = Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = Node("instrument", namespace="test", context=self.context, enable_rosout=False)
        n_sensors = len(self.layout.sensors)
        self.slopes = self._publisher(SlopeFrame, wire.SLOPES, RATE * n_sensors)
        self.commands = self._publisher(DmCommand, wire.COMMAND, RATE)
        self.events = self._publisher(HrtcEvent, wire.EVENT, 0.0)
        self._writers = [
            wire.SlopeFrameWriter(sensor.name, SESSION, self.layout.fingerprint, i, 1, sensor.n_valid)
            for i, sensor in enumerate(self.layout.sensors)
        ]
        self._command_writer = wire.DmCommandWriter("hrtc", self.layout.n_commands)
        status_qos = QoSProfile(**wire.RECORDER_STATUS.qos())
        self._status = self.node.create_subscription(
            RecorderStatus, wire.RECORDER_STATUS.name, lambda _: None, status_qos
        )

    def _publisher(self, kind: type, topic: wire.Topic, per_second: float):
        return self.node.create_publisher(kind, topic.name, QoSProfile(**topic.qos(topic.depth_at(per_second))))

    def status(self, wanted, timeout: float = 20.0) -> RecorderStatus:
        """The first status of the recorder from now on that is as wanted."""
        deadline = time.monotonic() + timeout
        while time.monotonic() < deadline:
            taken = self._status.handle.take_message(RecorderStatus, False)
            if taken is not None and wanted(taken[0]):
                return taken[0]
            time.sleep(0.01)
        raise AssertionError("the recorder did not report what was waited for")

    def wait_for_recorder(self) -> None:
        self.status(lambda status: status.slope_publishers == 1 and status.command_publishers == 1)

    def send(self, frame: int) -> list[bytes]:
        """All slopes of a frame and its command; returns what was sent."""
        sent = []
        for writer in self._writers:
            writer.values[:] = np.random.default_rng(frame).standard_normal(len(writer.values))
            sent.append(writer.write(time.time_ns(), frame, -1, -1, 1.0))
            self.slopes.publish(sent[-1])
        fields = (SESSION, frame, 0, 0, 15, 0, 1, 0, 0.5, -1, -1, -1, 1.0, 1e-4)
        self._command_writer.values[:] = frame
        sent.append(self._command_writer.write(0, 0, *fields))
        self.commands.publish(sent[-1])
        return sent

    def run(self, frames, rate: float = RATE) -> list[bytes]:
        """Send frames at a rate; a late one is sent at once."""
        sent = []
        start = time.perf_counter()
        for count, frame in enumerate(frames):
            time.sleep(max(0.0, start + count / rate - time.perf_counter()))
            sent += self.send(frame)
        return sent

    def adopt(self, first_frame: int) -> None:
        self.events.publish(HrtcEvent(kind=HrtcEvent.SESSION, session=SESSION, first_frame=first_frame))

    def close(self) -> None:
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)


@pytest.fixture
def instrument(ros_domain):
    instrument = Instrument(ros_domain)
    yield instrument
    instrument.close()


@pytest.fixture
def start_recorder(start_process, tmp_path):
    def start(*options: str):
        process = start_process(
            *("-m", "srtomo_rtc.recorder_node", tmp_path / "bag", "--system", "mini", "--namespace", "test"),
            *("--json", tmp_path / "report.json", *options),
        )
        process.wait_for("recording")
        return process

    return start


def test_nothing_is_lost_at_full_rate(instrument, start_recorder, tmp_path):
    recorder = start_recorder()
    instrument.wait_for_recorder()
    instrument.adopt(0)
    sent = instrument.run(range(2000))
    assert recorder.interrupt() == 0, recorder.output

    report = json.loads((tmp_path / "report.json").read_text())
    assert (report["frames"], report["lost"], report["malformed"]) == (2000, 0, 0)
    assert report["topics"]["/test/wfs/slopes"] == {"recorded": 8000, "lost": 0, "duplicates": 0}
    assert report["topics"]["/test/hrtc/command"] == {"recorded": 2000, "lost": 0, "duplicates": 0}
    assert report["topics"]["/test/hrtc/event"]["recorded"] == 1
    assert set(report["topics"]) == {
        topic.name if topic.name.startswith("/") else f"/test/{topic.name}" for topic in wire.TOPICS
    }
    assert "2000 whole frames, 0 messages lost" in recorder.output

    with BagReader(tmp_path / "bag") as reader:
        assert reader.cut is None
        assert reader.metadata["fingerprint"] == instrument.layout.fingerprint.hex()
        assert reader.metadata["n_commands"] == str(instrument.layout.n_commands)
        assert '"name":"mini"' in reader.metadata["system"]
        hot = [reader.topic(wire.SLOPES.name), reader.topic(wire.COMMAND.name)]
        recorded = list(reader.messages(*hot))
        assert sorted(message.data for message in recorded) == sorted(sent)
        times = [message.log_time for message in recorded]
        assert times == sorted(times) and abs(times[-1] - time.time_ns()) < 60e9
        statuses = list(reader.messages(reader.topic(wire.RECORDER_STATUS.name)))
        last = decode(statuses[-1].type, statuses[-1].data)
        assert (last.slope_publishers, last.command_publishers, last.lost) == (1, 1, 0)
        assert 0 < last.frames <= 2000 and last.bytes > 0 and last.bag.endswith("bag")


def test_what_is_missing_is_counted(instrument, start_recorder, tmp_path):
    recorder = start_recorder()
    instrument.wait_for_recorder()
    instrument.adopt(0)
    instrument.run([*range(0, 50), *range(51, 80), 79, *range(80, 100)])
    status = instrument.status(lambda status: status.frames == 99)
    assert status.lost == 5  # of frame 50, four sensors' slopes and the command
    assert recorder.interrupt() == 0
    report = json.loads((tmp_path / "report.json").read_text())
    assert (report["frames"], report["lost"]) == (99, 5)
    assert report["topics"]["/test/wfs/slopes"] == {"recorded": 400, "lost": 4, "duplicates": 4}
    assert report["topics"]["/test/hrtc/command"] == {"recorded": 100, "lost": 1, "duplicates": 1}
    (session,) = report["sessions"]
    assert session["session"] == SESSION
    assert session["commands"]["gaps"] == [[50, 50]]
    assert [stream["gaps"] for stream in session["slopes"]] == [[[50, 50]]] * 4


def test_a_killed_recorder_leaves_a_bag_that_can_be_mended(instrument, start_recorder, tmp_path):
    recorder = start_recorder()
    instrument.wait_for_recorder()
    instrument.run(range(1250))  # more than the time after which everything is flushed
    recorder.kill()
    with BagReader(tmp_path / "bag") as reader:
        assert reader.cut is not None and "whole records" in reader.cut
        messages = list(reader.messages(reader.topic(wire.COMMAND.name)))
        frames = [wire.read_dm_command(message.data).frame for message in messages]
        assert frames == list(range(len(frames))) and len(frames) > 500
    assert repair(tmp_path / "bag", tmp_path / "mended") == reader.message_count
    with BagReader(tmp_path / "mended") as mended:
        assert mended.cut is None
        assert mended.metadata == reader.metadata
        assert mended.counts == reader.counts


def test_a_chosen_topic_and_a_polite_end(instrument, start_process, tmp_path):
    arguments = ("-m", "srtomo_rtc.recorder_node", tmp_path / "bag", "--system", "mini", "--namespace", "test")
    recorder = start_process(*arguments, "--topics", "hrtc/event")
    recorder.wait_for("recording 1 topics")
    instrument.adopt(5)
    instrument.status(lambda status: status.messages == 1)
    assert recorder.interrupt() == 0
    with BagReader(tmp_path / "bag") as reader:
        assert reader.counts == {"/test/hrtc/event": 1}


def test_a_long_recording_is_split_and_keeps_to_its_limit(instrument, start_process, tmp_path):
    arguments = ("record", "mini", "-o", tmp_path / "bag", "--namespace", "test", "--split", "0.1", "--limit", "1.2")
    recorder = start_process("-m", "srtomo_ops.cli", *arguments, "--json", tmp_path / "report.json")
    instrument.wait_for_recorder()
    instrument.adopt(0)
    instrument.run(range(4000))
    assert recorder.interrupt() == 0, recorder.output
    report = json.loads((tmp_path / "report.json").read_text())
    assert (report["frames"], report["lost"]) == (4000, 0)
    assert report["removed_files"] > 0 and "removed to stay within the limit" in recorder.output
    assert sum(file.stat().st_size for file in (tmp_path / "bag").glob("*.mcap")) < 1.2e6
    with BagReader(tmp_path / "bag") as reader:
        assert reader.cut is None
        assert reader.counts["/test/hrtc/event"] == 1  # of frame 0: a replay needs it
        messages = list(reader.messages(reader.topic(wire.COMMAND.name)))
        frames = [wire.read_dm_command(message.data).frame for message in messages]
        assert frames == list(range(frames[0], 4000)) and len(frames) > 500


def test_a_publisher_that_offers_too_little_is_reported(instrument, start_recorder, tmp_path):
    recorder = start_recorder()
    qos = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    instrument.node.create_publisher(DmCommand, wire.COMMAND.name, qos)
    recorder.wait_for("/test/hrtc/command: a publisher offers less than reliable")
    assert recorder.interrupt() == 0
    assert json.loads((tmp_path / "report.json").read_text())["unrecorded"] == ["/test/hrtc/command"]


def test_a_full_disk_ends_the_recorder_with_one_line(instrument, start_recorder):
    recorder = start_recorder()
    instrument.wait_for_recorder()
    # a file that may not grow is to the writer what a full disk is
    resource.prlimit(recorder.pid, resource.RLIMIT_FSIZE, (300_000, 300_000))
    instrument.run(range(1000))
    assert recorder.wait() == 1
    errors = [line for line in recorder.output.splitlines() if not line.startswith("recording")]
    assert len(errors) == 1 and "cannot be written" in errors[0], recorder.output


def test_a_bag_that_exists_is_refused_before_anything_starts(start_process, tmp_path):
    (tmp_path / "bag").mkdir()
    for options, news in (
        (("--system", "mini"), "exists already"),
        (("--system", "nowhere"), "expected the path of a .yaml file"),
        (("--system", "mini", "--topics", "wfs/slope"), "topic wfs/slope: expected some of wfs/slopes"),
    ):
        process = start_process("-m", "srtomo_rtc.recorder_node", tmp_path / "bag", *options)
        assert process.wait() == 1
        assert news in process.output and len(process.output.splitlines()) == 1
