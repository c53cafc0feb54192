"""Calls to running nodes, as an operator makes them: lifecycle, closing the loop, publishing and committing."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from msgs_schema.msg import HrtcStatus, RecorderStatus, SimStatus
from msgs_schema.srv import ChangeSky, CloseSensor, PublishReconstructor, SwapReconstructor
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.client import Client
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.qos import QoSProfile
from std_srvs.srv import SetBool, Trigger

from srtomo_core import wire

TRANSITIONS = {
    "configure": Transition.TRANSITION_CONFIGURE,
    "activate": Transition.TRANSITION_ACTIVATE,
    "deactivate": Transition.TRANSITION_DEACTIVATE,
    "cleanup": Transition.TRANSITION_CLEANUP,
}


TRANSITION = 15.0  # s that one may take before the state is looked at, and then again

REACHED = {"configure": "inactive", "activate": "active", "deactivate": "inactive", "cleanup": "unconfigured"}


class OperatorError(ValueError):
    """A node that does not answer, or refuses; one line with its reason."""


class NoAnswer(OperatorError):
    """It was asked, and has not answered in time."""


class Operator(Node):
    """A node that calls the others and remembers their latest status. One thread calls everything.

    Args:
        patience: s to wait for a service that nobody offers yet.

    Attributes:
        hrtc, recorder, sim: the latest status of each, or None.
    """

    def __init__(self, namespace: str = "", name: str = "operator", patience: float = 30.0) -> None:
        super().__init__(name, namespace=namespace)
        self._patience = patience
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self)
        self.hrtc: HrtcStatus | None = None
        self.recorder: RecorderStatus | None = None
        self.sim: SimStatus | None = None
        self._asked: dict[str, Client] = {}
        for topic, kind, attribute in (
            (wire.STATUS, HrtcStatus, "hrtc"),
            (wire.RECORDER_STATUS, RecorderStatus, "recorder"),
            (wire.SIM_STATUS, SimStatus, "sim"),
        ):
            self.create_subscription(kind, topic.name, partial(setattr, self, attribute), QoSProfile(**topic.qos()))

    def spin(self, seconds: float) -> None:
        """Take messages for a while."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=left)

    def poll(self) -> None:
        """Take one message or answer, if any waits."""
        self._executor.spin_once(timeout_sec=0.0)

    def call(self, kind: Any, service: str, request: Any, timeout: float = 10.0) -> Any:
        """Call a service.

        Raises:
            OperatorError: it is not there; NoAnswer: it does not answer in time.
        """
        client = self._asked.get(service)
        if client is None:
            client = self.create_client(kind, service)
            try:
                self._wait_for(client)
            except OperatorError:
                self.destroy_client(client)
                raise
            # rmw_fastrtps drops an answer when it has not found the asker's reader yet, and tells nobody
            # (https://github.com/ros2/rmw_fastrtps/issues/842): the server gets a moment to find this client.
            self.spin(0.1)
            self._asked[service] = client
        return self.ask(client, request, timeout)

    def _wait_for(self, client: Client) -> None:
        end = time.monotonic() + self._patience
        while not client.service_is_ready():
            if time.monotonic() > end:
                name = client.service_name
                raise OperatorError(f"{name}: nobody offers this service in namespace {self.get_namespace()}")
            self.spin(0.05)

    def ask(self, client: Client, request: Any, timeout: float = 10.0) -> Any:
        """Call a service through a client that is there already: for many calls in a short time.

        Raises:
            OperatorError: the service is not there; NoAnswer: it does not answer in time.
        """
        self._wait_for(client)
        end = time.monotonic() + timeout
        future = client.call_async(request)
        while not future.done():
            if time.monotonic() > end:
                raise NoAnswer(f"{client.service_name}: no answer in {timeout:g} s")
            self._executor.spin_once(timeout_sec=0.05)
        return future.result()

    def ready(self, kind: Any, service: str) -> bool:
        """Whether somebody offers a service now."""
        client = self.create_client(kind, service)
        self.spin(0.1)
        there = client.service_is_ready()
        self.destroy_client(client)
        return there

    def transition(self, name: str) -> None:
        """A lifecycle transition of the HRTC: a key of TRANSITIONS.

        Raises:
            OperatorError: it failed; the node's log says why.
        """
        # by the label rclpy finds out whether there is such a transition now; an id alone it would stumble over
        request = ChangeState.Request(transition=Transition(id=TRANSITIONS[name], label=name))
        try:
            success = self.call(ChangeState, "hrtc/change_state", request, timeout=TRANSITION).success
        except NoAnswer:  # it was lost, or this takes long: the state tells
            end = time.monotonic() + TRANSITION
            while (state := self.state()) != REACHED[name] and time.monotonic() < end:
                self.spin(0.2)
            success = state == REACHED[name]
        if not success:
            self.spin(0.3)
            state = f"the HRTC is {self.hrtc.state}" if self.hrtc is not None else "refused"
            raise OperatorError(f"{name}: {state}; if that allows it, the HRTC's log says why it failed")

    def state(self) -> str:
        """The HRTC's lifecycle state.

        Raises:
            OperatorError: it does not answer.
        """
        return str(self.call(GetState, "hrtc/get_state", GetState.Request()).current_state.label)

    def close_loop(self, closed: bool) -> None:
        """Close or open the loop.

        Raises:
            OperatorError: refused.
        """
        response = self.call(SetBool, "hrtc/close_loop", SetBool.Request(data=closed))
        if not response.success:
            raise OperatorError(f"hrtc/close_loop: {response.message}")

    def flatten(self) -> None:
        """Open the loop and put the static shape on at once, instead of relaxing to it.

        Raises:
            OperatorError: refused.
        """
        response = self.call(Trigger, "hrtc/flat", Trigger.Request())
        if not response.success:
            raise OperatorError(f"hrtc/flat: {response.message}")

    def change_parameters(self, words: Mapping[str, str]) -> None:
        """Change parameters of the HRTC while it runs; values as text, in the parameter's own unit.

        Raises:
            OperatorError: no such parameter, not a value of its type, or refused.
        """
        names = list(words)
        found = self.call(GetParameters, "hrtc/get_parameters", GetParameters.Request(names=names)).values
        parameters = []
        for i, name in enumerate(names):
            value = parameter_value_to_python(found[i]) if len(found) == len(names) else None
            if value is None:
                raise OperatorError(f"{name}: the HRTC has no such parameter")
            kind, word = type(value), words[name]
            if kind is bool and word not in ("true", "false"):
                raise OperatorError(f"{name}: expected true or false, got {word}")
            try:
                parameters.append(Parameter(name, value=word == "true" if kind is bool else kind(word)))
            except ValueError:
                raise OperatorError(f"{name}: expected {kind.__name__}, got {word}") from None
        request = SetParameters.Request(parameters=[parameter.to_parameter_msg() for parameter in parameters])
        for name, result in zip(names, self.call(SetParameters, "hrtc/set_parameters", request).results, strict=True):
            if not result.successful:
                raise OperatorError(f"{name}: {result.reason}")

    def close_sensors(self, sensors: Sequence[str], closed: bool) -> tuple[int, str]:
        """Take sensors, by name, out of the commands or put them back: the first frame, and what makes commands then.

        Raises:
            OperatorError: refused.
        """
        request = CloseSensor.Request(sensors=list(sensors), closed=closed)
        response = self.call(CloseSensor, "hrtc/close_sensor", request)
        if not response.success:
            raise OperatorError(f"hrtc/close_sensor: {response.message}")
        return int(response.first_frame), str(response.message)

    def start_sim(self) -> None:
        """Let the simulated plant publish its first frame.

        Raises:
            OperatorError: it has done so before.
        """
        response = self.call(Trigger, "sim/start", Trigger.Request())
        if not response.success:
            raise OperatorError(f"sim/start: {response.message}")

    def change_sky(self, changes: Mapping[str, str], over: float = 0.0, after: float = 0.0) -> int:
        """Change the simulated plant while it runs: the first frame that it is in.

        Args:
            changes: dotted keys of the instrument and their values, with unit.
            over: s that it takes; after: s until it begins; of the plant's time.

        Raises:
            OperatorError: refused.
        """
        request = ChangeSky.Request(keys=list(changes), values=list(changes.values()), over=over, after=after)
        response = self.call(ChangeSky, "sim/change", request)
        if not response.success:
            raise OperatorError(f"sim/change: {response.message}")
        return int(response.first_frame)

    def publish(self, label: str) -> tuple[int, bytes]:
        """Have the SRTC publish a reconstructor by its label: its id and SHA-256.

        Raises:
            OperatorError: the SRTC has none of that label.
        """
        response = self.call(PublishReconstructor, "srtc/publish", PublishReconstructor.Request(label=label))
        if not response.success:
            raise OperatorError(f"srtc/publish: {response.message}")
        return int(response.id), bytes(response.sha256)

    def wait_staged(self, identity: int, timeout: float = 15.0) -> None:
        """Wait until the HRTC has a reconstructor staged.

        Raises:
            OperatorError: it has not in time, or runs it already.
        """
        end = time.monotonic() + timeout
        while self.hrtc is None or self.hrtc.staged != identity:
            if self.hrtc is not None and self.hrtc.reconstructor == identity:
                raise OperatorError(f"reconstructor {identity:016x} is active already")
            if time.monotonic() > end:
                raise OperatorError(
                    f"reconstructor {identity:016x} was not staged in {timeout:g} s; the HRTC's log says why"
                )
            self.spin(0.05)

    def commit(self, identity: int, sha256: bytes, roll_back: bool = False) -> int:
        """Commit the staged reconstructor, or roll back to the previous one: the first frame made by it.

        Raises:
            OperatorError: refused.
        """
        service = "hrtc/roll_back" if roll_back else "hrtc/commit"
        request = SwapReconstructor.Request(id=identity, sha256=list(sha256))
        response = self.call(SwapReconstructor, service, request)
        if not response.success:
            raise OperatorError(f"{service}: {response.message}")
        return int(response.first_frame)
