"""A small known shape on the mirrors whose sign changes again and again, so that sensors' places show in telemetry."""

from __future__ import annotations

import time
from array import array

import numpy as np
from msgs_schema.srv import SetStaticShape

from srtomo_core.layout import Layout
from srtomo_core.system import System
from srtomo_ops.operator import Operator, OperatorError
from srtomo_srtc.mirrors import interaction_matrix
from srtomo_srtc.register import dither_pattern

HALF_PERIOD = 0.02
"""Seconds that each sign lasts; as much longer as the HRTC takes to answer. Turbulence hardly changes meanwhile."""

_SERVICE = "hrtc/static_shape"


class Dither:
    """The shape of an instrument: its offset and the slope reference that belongs to it, as requests.

    Args:
        rms: of the wavefront over the pupil, m.
    """

    def __init__(self, system: System, rms: float) -> None:
        layout = Layout(system)
        offset = dither_pattern(system, layout, rms)
        reference = -interaction_matrix(system, layout) @ offset
        self._signs = [
            SetStaticShape.Request(
                offset=array("f", np.float32(sign * offset).tobytes()),
                slope_reference=array("f", np.float32(sign * reference).tobytes()),
            )
            for sign in (1, -1)
        ]

    def run(self, operator: Operator, seconds: float) -> int:
        """Shake the mirrors, in place of any static shape that they hold; flat at the end.

        Returns:
            How often the sign changed.

        Raises:
            OperatorError: the HRTC refused or did not answer.
        """
        client = operator.create_client(SetStaticShape, _SERVICE)

        def put(request: SetStaticShape.Request) -> None:
            response = operator.ask(client, request)
            if not response.success:
                raise OperatorError(f"{_SERVICE}: {response.message}")

        changes, end = 0, time.monotonic() + seconds
        try:
            while time.monotonic() < end:
                turn = time.monotonic() + HALF_PERIOD
                put(self._signs[changes % 2])
                changes += 1
                operator.spin(turn - time.monotonic())
            return changes
        finally:
            put(SetStaticShape.Request())
            operator.destroy_client(client)
