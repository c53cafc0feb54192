"""Tip-tilt in a loop of its own over ROS 2: all nodes as processes, and the replay of their bag."""

import json

import pytest

from srtomo_core import wire
from srtomo_core.bag import BagReader
from srtomo_ops import cli

SECONDS, FRAMES, EVERY = 6, 1200, 5  # of mini_tip_tilt: 200 Hz, and 40 Hz for the stars
STARS = 1 << 1 | 1 << 4 | 1 << 5


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_every_frame_of_the_stars_is_in_a_command_and_replays(start_process, tmp_path, capsys):
    pytest.importorskip("rclpy")
    words = ("demo", "mini_tip_tilt", "--set", "atmosphere.outer_scale=8 m", "--seconds", str(SECONDS))
    demo = start_process("-m", "srtomo_ops.cli", *words, "-o", tmp_path / "run", "--json", tmp_path / "demo.json")
    assert demo.wait(200) == 0, demo.output
    numbers = json.loads((tmp_path / "demo.json").read_text())
    assert (numbers["frames_recorded"], numbers["frames_lost"], numbers["messages_lost"]) == (FRAMES, 0, 0)

    taken, sent = [], set()
    with BagReader(numbers["bag"]) as reader:
        slopes, commands = reader.topic(wire.SLOPES.name), reader.topic(wire.COMMAND.name)
        for message in reader.messages(slopes, commands):
            if message.topic == slopes:
                frame = wire.read_slope_frame(message.data)
                if STARS >> frame.sensor & 1:
                    sent.add((frame.frame, frame.sensor))
                continue
            command = wire.read_dm_command(message.data)
            if command.sensors & STARS:
                taken.append((command.frame, command.tip_tilt_frame, command.sensors & STARS))
    n = FRAMES // EVERY - 1  # the last is read out after the end
    assert sent == {(j, w) for j in range(n) for w in (1, 4, 5)}
    # a command a frame of the stars, all of them in it, a frame of the high orders after their exposure
    assert [(j, stars) for _, j, stars in taken] == [(j, STARS) for j in range(n)]
    assert all(k in (EVERY * (j + 1), EVERY * (j + 1) + 1) for k, j, _ in taken)

    capsys.readouterr()
    assert cli.main(["replay", numbers["bag"]]) == 0
    assert f"{FRAMES} frames compared (0 to {FRAMES - 1}, 0 held), 0 differ" in capsys.readouterr().out
