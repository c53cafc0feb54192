"""Everything at once, in wall-clock time: whatever the order of things was, the recording replays bit for bit."""

import random

import numpy as np
import pytest

from srtomo_core import wire
from srtomo_core.bag import BagReader
from srtomo_core.layout import Layout
from srtomo_core.reconstructor import save_interaction_matrix
from srtomo_core.system import load_system
from srtomo_rtc.replay import Replay
from srtomo_sim.mirror import interaction_matrix

rclpy = pytest.importorskip("rclpy", reason="needs rclpy: pip install '.[ros]', or source ROS 2 Jazzy")

from msgs_schema.srv import SetStaticShape  # noqa: E402
from rcl_interfaces.srv import SetParameters  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402

from srtomo_ops.operator import Operator, OperatorError  # noqa: E402

FRAMES = 4000
RATE = ["--set", "loop.rate=500 Hz"]


class Hands:
    """An operator who tries everything, in random order. What the HRTC refuses is no error, what it says must hold."""

    def __init__(self, operator: Operator, seed: int) -> None:
        self.operator = operator
        self.chance = random.Random(seed)
        self.known: list[tuple[int, bytes]] = []  # active first, previous last
        self.swaps: dict[int, int] = {}  # first frame by reconstructor, as the service told

    def load(self, label: str) -> None:
        identity, sha256 = self.operator.publish(label)
        self.operator.wait_staged(identity)
        self.operator.commit(identity, sha256)
        self.known.insert(0, (identity, sha256))

    def do_something(self) -> None:
        acts = (self.swap, self.swap, self.set, self.limit, self.shape, self.loop, self.operator.flatten)
        acts += (self.publish, self.rest)
        self.chance.choice(acts)()
        self.operator.spin(self.chance.random() * 0.03)

    def swap(self) -> None:
        identity, sha256 = self.known[-1]
        self.swaps[self.operator.commit(identity, sha256, roll_back=True)] = identity
        self.known.reverse()

    def set(self) -> None:
        self._set({"leak": self.chance.random() * 0.1, "polc": self.chance.random() < 0.9})

    def limit(self) -> None:
        chance = self.chance
        limits = {"slew_limit": 1e-7, "rms_limit": 5e-7, "watchdog": 0.5}
        values: dict[str, float | int] = {name: chance.random() * most for name, most in limits.items()}
        self._set({"gain_ramp": chance.randrange(100), **values, **dict.fromkeys(chance.sample(list(limits), 1), 0.0)})

    def _set(self, values: dict[str, float | int]) -> None:
        parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        self.operator.call(SetParameters, "hrtc/set_parameters", SetParameters.Request(parameters=parameters))

    def shape(self) -> None:
        offset = [self.chance.gauss(0, 1e-8) for _ in range(101)]
        self.operator.call(SetStaticShape, "hrtc/static_shape", SetStaticShape.Request(offset=offset))

    def loop(self) -> None:
        try:
            self.operator.close_loop(self.chance.random() < 0.7)
        except OperatorError as error:
            assert "opened again by itself" in str(error)

    def publish(self) -> None:
        self.operator.publish(self.chance.choice(("ground", "file")))

    def rest(self) -> None:
        if self.chance.random() < 0.2:
            self.operator.transition("deactivate")
            self.operator.spin(self.chance.random() * 1.5)
            self.operator.transition("activate")


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize("seed", [1, 2])
def test_whatever_is_done_replays(start_process, tmp_path, seed):
    system = load_system("mini")
    layout = Layout(system)
    save_interaction_matrix(tmp_path / "g.npz", interaction_matrix(system, layout), layout.fingerprint, {})

    def start(*words):
        return start_process("-m", "srtomo_ops.cli", *words)

    matrix = f"interaction_matrix:={tmp_path / 'g.npz'}"
    hrtc = start("hrtc", "mini", *RATE, "-p", matrix, "-p", "fault_budget:=5")
    start("srtc", "mini", "-p", 'priors:=["ground","file"]')
    recorder = start("record", "mini", *RATE, "-o", tmp_path / "bag")
    plant = start("sim", "mini", *RATE, "-p", f"frames:={FRAMES}")
    recorder.wait_for("recording")
    rclpy.init()
    operator = Operator()
    try:
        operator.transition("configure")
        operator.transition("activate")
        plant.wait_for("sky 100 %", timeout=120)
        hands = Hands(operator, seed)
        hands.load("ground")
        hands.load("file")
        operator.start_sim()
        while operator.sim is None or operator.sim.frame < FRAMES - 300:
            hands.do_something()
        operator.transition("deactivate")
        operator.spin(0.3)
    finally:
        operator.destroy_node()
        rclpy.shutdown()
    recorder.interrupt(120)
    assert hrtc.terminate() == 0, hrtc.output
    assert "Traceback" not in hrtc.output

    with BagReader(tmp_path / "bag") as reader:
        commands = [wire.read_dm_command(message.data) for message in reader.messages("/hrtc/command")]
        outcome = Replay(reader).run()
    frames = [command.frame for command in commands]
    assert frames == sorted(set(frames))
    assert all(np.isfinite(command.commands).all() for command in commands)
    assert (outcome.compared, outcome.differing, outcome.skipped) == (len(commands), 0, 0), outcome
    made_by = dict(zip(frames, (command.reconstructor for command in commands), strict=True))
    told = [first for first in hands.swaps if first in made_by]
    assert len(told) > 10
    assert all(made_by[first] == hands.swaps[first] for first in told)
