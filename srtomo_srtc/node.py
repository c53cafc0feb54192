"""The SRTC as a ROS 2 node: builds reconstructors from its priors and publishes them on request.

It computes with one BLAS thread under SCHED_IDLE, so that the loop beside it is not disturbed. It does not commit: that
is the operator's call.
"""

from __future__ import annotations

import os

# before numpy loads
for _variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_variable] = "1"

import json
import signal
import threading
from collections.abc import Callable, Iterable, Sequence
from types import FrameType
from typing import Any

import rclpy
from msgs_schema.msg import AtmosphereProfile
from msgs_schema.msg import Reconstructor as ReconstructorMsg
from msgs_schema.msg import ReconstructorBlock as ReconstructorBlockMsg
from msgs_schema.srv import PublishReconstructor
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions

from srtomo_core import wire
from srtomo_core.reconstructor import Reconstructor, block_table
from srtomo_core.system import InstrumentError, System, load_system
from srtomo_srtc.model import ground_prior
from srtomo_srtc.reconstructors import implicit

PRIORS: dict[str, Callable[[System], System]] = {"file": lambda system: system, "ground": ground_prior}
"""What a reconstructor may suppose of the sky: the instrument file's profile, or all turbulence at the ground."""


_PARAMETERS: tuple[tuple[str, Any, str], ...] = (
    ("system", "", "instrument: name or path of a .yaml file"),
    ("changes", "{}", 'changes to the instrument as JSON, e.g. {"loop.rate": "1 kHz"}'),
    ("priors", ["file"], f"reconstructors to build at the start, by prior: {', '.join(PRIORS)}"),
)


def parameters() -> Iterable[tuple[str, Any, str]]:
    """Name, default and description of each parameter; all are read-only."""
    return _PARAMETERS


class SrtcNode(Node):
    """The node ``srtc``. Everything runs on the executor's thread."""

    def __init__(self) -> None:
        super().__init__("srtc")
        for name, default, description in parameters():
            self.declare_parameter(name, default, ParameterDescriptor(description=description, read_only=True))
        self._manifests = self.create_publisher(
            ReconstructorMsg, wire.RECONSTRUCTOR.name, QoSProfile(**wire.RECONSTRUCTOR.qos())
        )
        self._blocks = self.create_publisher(
            ReconstructorBlockMsg, wire.RECONSTRUCTOR_BLOCK.name, QoSProfile(**wire.RECONSTRUCTOR_BLOCK.qos())
        )
        self._profiles = self.create_publisher(AtmosphereProfile, wire.PROFILE.name, QoSProfile(**wire.PROFILE.qos()))
        self._built: dict[str, tuple[System, Reconstructor]] = {}

    def build(self) -> None:
        """Build a reconstructor for every prior; from then on they can be asked for.

        Raises:
            InstrumentError: the instrument or a prior's name is wrong.
        """
        value = self.get_parameter("system").value
        if not value:
            raise InstrumentError("parameter system: expected a name or the path of a .yaml file")
        system = load_system(value, json.loads(self.get_parameter("changes").value))
        for prior in self.get_parameter("priors").value:
            if prior not in PRIORS:
                raise InstrumentError(f"parameter priors: expected some of {', '.join(PRIORS)}, got {prior!r}")
            believed = PRIORS[prior](system)
            reconstructor, _ = implicit(believed, label=prior)
            self._built[prior] = (believed, reconstructor)
            self.get_logger().info(f"built {prior}: {reconstructor.id:016x}")
        self.create_service(PublishReconstructor, "srtc/publish", self._publish)

    def _publish(
        self, request: PublishReconstructor.Request, response: PublishReconstructor.Response
    ) -> PublishReconstructor.Response:
        found = [
            (label, believed, reconstructor)
            for label, (believed, reconstructor) in self._built.items()
            if request.label == label or (not request.label and request.id == reconstructor.id)
        ]
        if not found:
            wanted = request.label or f"{request.id:016x}"
            response.message = f"no reconstructor {wanted!r} here, only {', '.join(self._built) or 'none yet'}"
            return response
        label, believed, reconstructor = found[0]
        if request.blocks:
            self._send_blocks(reconstructor, set(request.blocks))
        else:
            self._send_profile(label, believed, reconstructor)
            self._send_manifest(reconstructor)
            self._send_blocks(reconstructor, None)
        response.success = True
        response.message = label
        response.id = reconstructor.id
        response.sha256 = list(reconstructor.sha256)
        return response

    def _send_manifest(self, reconstructor: Reconstructor) -> None:
        message = ReconstructorMsg(
            id=reconstructor.id,
            sha256=list(reconstructor.sha256),
            fingerprint=list(reconstructor.fingerprint),
            n_commands=reconstructor.n_commands,
            n_slopes=reconstructor.n_slopes,
            n_epochs=reconstructor.n_epochs,
            n_blocks=len(block_table(reconstructor.n_commands, reconstructor.n_epochs)),
            gain=reconstructor.gain,
            slope_reference=reconstructor.slope_reference.tolist(),
            command_limit=reconstructor.command_limit.tolist(),
            probe_commands=reconstructor.probe_commands.ravel().tolist(),
            probe_slopes=reconstructor.probe_slopes.ravel().tolist(),
            label=reconstructor.label,
            provenance=json.dumps(dict(reconstructor.provenance)),
        )
        message.header.stamp = self.get_clock().now().to_msg()
        self._manifests.publish(message)

    def _send_blocks(self, reconstructor: Reconstructor, only: Iterable[int] | None) -> None:
        for block in reconstructor.blocks():
            if only is None or block.index in only:
                self._blocks.publish(
                    wire.write_block(
                        wire.ReconstructorBlock(
                            reconstructor.id, reconstructor.sha256, block.index, block.epoch, block.matrix,
                            block.first_row, block.rows,
                        )
                    )
                )  # fmt: skip

    def _send_profile(self, source: str, believed: System, reconstructor: Reconstructor) -> None:
        atmosphere = believed.atmosphere
        message = AtmosphereProfile(
            reconstructor=reconstructor.id,
            source=source,
            r0=atmosphere.r0,
            outer_scale=atmosphere.outer_scale,
            altitude=[layer.altitude for layer in atmosphere.layers],
            fraction=list(atmosphere.fractions),
            wind_speed=[layer.wind_speed for layer in atmosphere.layers],
            wind_direction=[layer.wind_direction for layer in atmosphere.layers],
        )
        message.header.stamp = self.get_clock().now().to_msg()
        self._profiles.publish(message)


def main(arguments: Sequence[str] | None = None) -> int:
    """Build, then serve until SIGINT or SIGTERM. ``arguments``: ROS arguments (``--ros-args -p system:=mini ...``)."""
    rclpy.init(args=None if arguments is None else list(arguments), signal_handler_options=SignalHandlerOptions.NO)
    stop = threading.Event()

    def on_signal(number: int, frame: FrameType | None) -> None:
        stop.set()

    signal.signal(signal.SIGINT, on_signal)
    signal.signal(signal.SIGTERM, on_signal)
    node = SrtcNode()
    try:
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    except OSError as error:
        node.get_logger().warning(f"SCHED_IDLE refused: {error}")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        node.build()
        while not stop.is_set():
            executor.spin_once(timeout_sec=0.1)
    except InstrumentError as error:
        node.get_logger().error(str(error))
        return 2
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.shutdown()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
