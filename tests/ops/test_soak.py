"""``srtomo bench soak``: that its check finds what must not be, and the whole of it, short."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from srtomo_core import wire
from srtomo_core.bag import BagMessage, BagWriter
from srtomo_core.layout import Layout
from srtomo_core.system import load_system
from srtomo_core.wire import DmCommandWriter, read_dm_command
from srtomo_ops.bench.soak import LEAK, Memory, in_force
from srtomo_ops.bench.soak_check import Check, SoakError
from srtomo_ops.bench.soak_plan import Fault, Matrices, Plan, Sensors
from srtomo_ops.simulate import plain_settings
from srtomo_rtc.hrtc import Hrtc
from srtomo_rtc.swap import Swap

FRAMES = 900
SWAP_EVERY = 60


@pytest.fixture(scope="module")
def soaked() -> SimpleNamespace:
    """A soak of an HRTC in this process: what is recorded of it, one message after the other."""
    system = load_system("mini")
    layout = Layout(system)
    plan, matrices = Plan.of(layout, FRAMES, 1), Matrices.of(system, layout, 1)
    recorded: list[BagMessage] = []

    def record(topic: wire.Topic, data: bytes) -> None:
        recorded.append(BagMessage("/" + topic.name, topic.type, data, len(recorded), len(recorded), 0))

    hrtc = Hrtc(layout, system.loop.delay, lambda data: record(wire.COMMAND, data))
    swap = Swap(system, layout, matrices.G.astype(np.float32), plain_settings(layout, LEAK), hrtc.loop.post)
    swaps = []
    hrtc.start()
    sensors, late = Sensors(plan), []
    for frame in range(FRAMES):
        if frame % SWAP_EVERY == 0:
            one = matrices.good[frame // SWAP_EVERY % len(matrices.good)]
            swap.stage_whole(one)
            swap.commit(one.id, one.sha256)
            hrtc.idle(frame)
            swaps.append((frame, one.id))
            hrtc.loop.request(closed=True)
            hrtc.idle(frame)
        made = sensors.messages(frame, frame)
        if plan.faults[frame] in (Fault.LATE, Fault.OVERTAKEN):
            late = made
            continue
        for message in made + late:
            record(wire.SLOPES, message)
            hrtc.offer(message, frame)
            hrtc.advance()
        late = []
    return SimpleNamespace(system=system, plan=plan, matrices=matrices, recorded=recorded, hrtc=hrtc, swaps=swaps)


def check_of(soaked: SimpleNamespace, **changes: Any) -> Check:
    values = {"plan": soaked.plan, "delay": soaked.system.loop.delay, "leak": LEAK} | changes
    return Check(**values, reconstructors=soaked.matrices.good)


def checked(soaked: SimpleNamespace, recorded: list[BagMessage], **changes: Any) -> Check:
    check = check_of(soaked, **changes)
    for message in recorded:
        check.take(message)
    check.finish()
    return check


def test_a_plan_has_every_fault_and_is_drawn_again_alike(soaked: SimpleNamespace) -> None:
    layout = soaked.plan.layout
    plan = Plan.of(layout, 20 * 8 * 100, 1)
    assert [int((plan.faults == fault).sum()) for fault in Fault][1:] == [20] * 8
    assert np.diff(np.flatnonzero(plan.faults)).min() > 10
    assert np.array_equal(plan.rows, Plan.of(layout, plan.frames, 1).rows)
    assert not np.array_equal(plan.rows, Plan.of(layout, plan.frames, 2).rows)


def test_what_is_right_passes(soaked: SimpleNamespace) -> None:
    """With the counters of the HRTC itself, whatever order the messages were recorded in."""
    jumbled = sorted(soaked.recorded, key=lambda message: message.log_time // 40 * 40 + hash(message.data) % 40)
    for recorded in (soaked.recorded, jumbled):
        check = checked(soaked, recorded)
        assert check.error < 2e-6
        assert check.contrast() > 1e-4
        assert check.swaps == soaked.swaps
        counters = {**vars(soaked.hrtc.counters), "loop_opened_by_faults": soaked.hrtc.loop.opened_by_faults}
        for name, value in check.expected_counters().items():
            assert counters[name] == value, name


def test_a_bag_is_read_file_by_file(soaked: SimpleNamespace, tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag", {}, split_bytes=400_000) as bag:
        for number, message in enumerate(soaked.recorded):
            bag.write(*message)
            if number % 100 == 0:
                bag.flush()
    files = sorted((tmp_path / "bag").glob("*.mcap"), key=lambda file: int(file.stem.rpartition("_")[2]))
    assert len(files) > 2
    check = check_of(soaked)
    for file in files:
        check.read(file)
    check.finish()
    assert check.swaps == soaked.swaps


def altered(message: BagMessage, change: Callable[[wire.DmCommand], wire.DmCommand]) -> BagMessage:
    command = change(read_dm_command(message.data))
    writer = DmCommandWriter("dm", len(command.commands))
    writer.values[:] = command.commands
    return message._replace(data=writer.write(*command[:-1]))


def places(soaked: SimpleNamespace, topic: wire.Topic) -> list[int]:
    return [i for i, message in enumerate(soaked.recorded) if message.type == topic.type]


@pytest.mark.parametrize("sensor", range(4))
def test_one_sensor_s_part_of_another_reconstructor_is_found(soaked: SimpleNamespace, sensor: int) -> None:
    frame = 5 * SWAP_EVERY
    place = places(soaked, wire.COMMAND)[frame]
    before, after = soaked.matrices.good[0], soaked.matrices.good[1]
    own = soaked.plan.layout.slopes_of(sensor)
    y = soaked.plan.slopes(frame, sensor)

    def mixed(command: wire.DmCommand) -> wire.DmCommand:
        assert command.reconstructor == after.id and command.verdict == 0
        part = after.gain * (before.R[0][:, own] - after.R[0][:, own]) @ y
        return command._replace(commands=(command.commands + part).astype(np.float32))

    recorded = [*soaked.recorded]
    recorded[place] = altered(recorded[place], mixed)
    with pytest.raises(SoakError, match=f"frame {frame}: commands are off by"):
        checked(soaked, recorded)


def test_what_is_wrong_is_found(soaked: SimpleNamespace) -> None:
    commands, slopes = places(soaked, wire.COMMAND), places(soaked, wire.SLOPES)
    at, held = commands[200], commands[int(np.flatnonzero(soaked.plan.faults == Fault.NO_FRAME)[0])]
    other = next(r.id for r in soaked.matrices.good if r.id != read_dm_command(soaked.recorded[at].data).reconstructor)

    def without(place: int) -> list[BagMessage]:
        return soaked.recorded[:place] + soaked.recorded[place + 1 :]

    def with_(place: int, **fields: Any) -> list[BagMessage]:
        recorded = [*soaked.recorded]
        recorded[place] = altered(recorded[place], lambda command: command._replace(**fields))
        return recorded

    def nudged(place: int) -> list[BagMessage]:
        message = soaked.recorded[place]
        return [*soaked.recorded[:place], message._replace(data=message.data[:-4] + bytes(4)), *without(place)[place:]]

    for recorded, reason in (
        (without(at), "frame 200 has no command"),
        (without(commands[-1]), f"frame {FRAMES - 1} has no command"),
        ([*soaked.recorded[: at + 1], *soaked.recorded[at:]], "a command for frame 200 of session 1 too many"),
        (with_(at, reconstructor=other), "frame 200: commands are off by"),
        (with_(at, reconstructor=7), "is none of ours"),
        (with_(at, verdict=3), "answered with HOLD_INCOMPLETE, loop closed"),
        (with_(at, loop_state=0), "answered with OK, loop open"),
        (with_(at, commands=np.full(101, np.nan, np.float32)), "frame 200: commands are off by"),
        (nudged(held), "commands are off by"),
        (nudged(slopes[300]), "are not those that were sent"),
        (without(slopes[300]), "messages of each sensor, sent"),
        ([*soaked.recorded, soaked.recorded[slopes[-1]]], "messages of each sensor, sent"),
    ):
        with pytest.raises(SoakError, match=reason):
            checked(soaked, recorded)
    for changes in ({"delay": 3.0}, {"leak": 0.0}):
        with pytest.raises(SoakError, match="commands are off by"):
            checked(soaked, soaked.recorded, **changes)


def test_memory_that_grows() -> None:
    times = [0.5 * i for i in range(100)]
    warming = [int(1e8 + min(t, 10.0) * 1e7) for t in times]
    assert Memory.of(times, warming, 10**6).growth == pytest.approx(0, abs=1)
    leaking = Memory.of(times, [size + int(2e6 * t) for t, size in zip(times, warming, strict=True)], 10**6)
    assert leaking.growth == pytest.approx(2e6 * 49.5, rel=1e-6)
    assert not leaking.flat(10**6)
    assert Memory.of(times, warming, 20_000).growth is None


def soak(start_process: Any, tmp_path: Path, *words: str) -> tuple[dict[str, Any], Any]:
    file = tmp_path / "soak.json"
    process = start_process("-m", "srtomo_ops.cli", "bench", "soak", *words, "--folder", tmp_path, "--json", file)
    assert process.wait(600) == 0, process.output
    return json.loads(file.read_text()), process


def test_the_whole_of_it(start_process: Any, tmp_path: Path) -> None:
    """All processes, each swap and each fault, in a recording of mini; what falls out of it is deleted."""
    found, process = soak(start_process, tmp_path, "mini", "--frames", "900", "--swap-every", "50")
    assert found["swaps"] == 17
    assert found["frames"] == sum(found["verdicts"].values()) == 900
    assert set(found["faults"].values()) <= {1, 2}
    assert found["error"] < 1e-5 < found["contrast"]
    assert found["refused"] >= 1
    assert "every frame has one command" in process.output
    assert not list(tmp_path.glob("srtomo-soak-*"))


def test_of_two_swaps_between_two_frames_the_later_one_counts() -> None:
    told = [(0, 1), (60, 2), (120, 1), (120, 3), (180, 2), (180, 3), (240, 1), (300, 2)]
    assert in_force(told, 300) == [(0, 1), (60, 2), (120, 3), (240, 1)]


@pytest.mark.slow
@pytest.mark.timeout(700)
def test_twenty_thousand_frames(start_process: Any, tmp_path: Path) -> None:
    """Long enough for several transfers and files; ``make soak`` is the same for a million, with a word on memory."""
    found, _ = soak(start_process, tmp_path, "gnao_ltao_sr", "--frames", "20000", "--split", "100")
    assert found["swaps"] == 19
    assert found["transfers"] >= 3
    assert found["refused"] >= 2
    assert found["files"] >= 2
