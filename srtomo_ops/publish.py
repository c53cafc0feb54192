"""A bag's slopes, published again at the recorded pace, as they were: a live HRTC cannot tell them from a sensor's."""

from __future__ import annotations

import time

import rclpy
from msgs_schema.msg import SlopeFrame
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions

from srtomo_core import wire
from srtomo_core.bag import BagReader

_WAIT = 10.0  # s for a reader


def publish_slopes(reader: BagReader, namespace: str = "", start: int = 0) -> int:
    """Publish every SlopeFrame of a bag from frame ``start`` on; how many messages that were.

    Raises:
        ValueError: nobody listens.
    """
    topic = reader.topic(wire.SLOPES.name)
    # rclpy's own handlers end the context under the call that Ctrl-C interrupts
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = Node("replay", namespace=namespace)
    try:
        publisher = node.create_publisher(SlopeFrame, wire.SLOPES.name, QoSProfile(**wire.SLOPES.qos(4096)))
        end = time.monotonic() + _WAIT
        while publisher.get_subscription_count() == 0:
            if time.monotonic() > end:
                raise ValueError(
                    f"nobody reads {wire.SLOPES.name} in namespace {node.get_namespace()}: is an HRTC running?"
                )
            time.sleep(0.05)
        time.sleep(0.5)  # let the reader's side match too
        count, offset = 0, 0.0
        for message in reader.messages(topic):
            if wire.read_slope_frame(message.data).frame < start:
                continue
            moment = message.log_time * 1e-9
            if count == 0:
                offset = time.monotonic() - moment
            left = moment + offset - time.monotonic()
            if left > 0:
                time.sleep(left)
            publisher.publish(message.data)
            count += 1
        time.sleep(0.5)  # reliable delivery needs the writer for as long as a reader may ask again
        return count
    finally:
        node.destroy_node()
        rclpy.shutdown()
