"""Calls whose answers are lost, as rmw_fastrtps loses some (ros2/rmw_fastrtps#842)."""

from __future__ import annotations

import threading

import pytest

rclpy = pytest.importorskip("rclpy", reason="needs rclpy: pip install '.[ros]', or source ROS 2 Jazzy")

from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.executors import SingleThreadedExecutor
from std_srvs.srv import Trigger

from srtomo_ops import operator as module
from srtomo_ops.operator import NoAnswer, Operator, OperatorError


@pytest.fixture
def ros(ros_domain):
    rclpy.init()
    yield
    rclpy.shutdown()


def test_an_answer_that_is_lost(ros, monkeypatch):
    """A server that never answers stands for lost answers: the state says what became of a transition."""
    monkeypatch.setattr(module, "TRANSITION", 0.3)
    silent, talking = rclpy.create_node("silent"), rclpy.create_node("talking")
    silent.create_service(ChangeState, "hrtc/change_state", lambda request, response: response)
    silent.create_service(Trigger, "sim/start", lambda request, response: response)

    def inactive(request, response):
        response.current_state.label = "inactive"
        return response

    talking.create_service(GetState, "hrtc/get_state", inactive)
    executor = SingleThreadedExecutor()
    executor.add_node(talking)
    thread = threading.Thread(target=executor.spin, daemon=True)
    thread.start()
    operator = Operator()
    try:
        operator.transition("configure")
        with pytest.raises(OperatorError, match="activate: refused"):
            operator.transition("activate")
        with pytest.raises(NoAnswer, match="sim/start: no answer"):
            operator.call(Trigger, "sim/start", Trigger.Request(), timeout=0.2)
    finally:
        executor.shutdown()
        thread.join()
