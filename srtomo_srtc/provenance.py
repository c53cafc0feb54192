"""Where a reconstructor comes from, and what its making took."""

from __future__ import annotations

import importlib.metadata
import time
from collections.abc import Callable, Mapping
from typing import Any

import numba
import numpy as np
import scipy
from numpy.typing import NDArray

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_core.system import InstrumentError, System

Array = NDArray[np.float64]


class Stages:
    """Names and times of the stages, told to whoever wants to know."""

    def __init__(self, progress: Callable[[str, float], None] | None) -> None:
        self.seconds: dict[str, float] = {}
        self._progress = progress
        self._name = ""
        self._since = 0.0

    def enter(self, name: str, done: float) -> None:
        """The stage ``name`` begins, with a share ``done`` (0 to 1) of the whole behind it."""
        now = time.perf_counter()
        if self._name:
            self.seconds[self._name] = round(now - self._since, 3)
        self._name, self._since = name, now
        if self._progress is not None:
            self._progress(name, done)

    def within(self, done: float, first: float, last: float) -> None:
        """A share ``done`` of the stage is behind, whose own shares of the whole are ``first`` to ``last``."""
        if self._progress is not None:
            self._progress(self._name, (1 - done) * first + done * last)


def provenance(system: System, method: str, gain: float, seconds: dict[str, float], **details: Any) -> dict[str, Any]:
    """What a reconstructor's file says of its origin; JSON values.

    Args:
        method: how it was made, as ``srtomo reconstruct --method`` calls it.
        gain: loop gain g whose filter ``g / (2-g)`` the noise prior went through.
        seconds: of each stage.
        details: the method's own parameters.
    """
    try:
        own_version = importlib.metadata.version("srtomo")
    except importlib.metadata.PackageNotFoundError:
        own_version = "not installed"
    return {
        "method": method,
        "system": system.name,
        "zenith_angle_rad": system.zenith_angle,
        "atmosphere": system.atmosphere.model_dump(mode="json"),
        "noise": {
            "gain": gain,
            "variance_factor": gain / (2 - gain),
            "rate_hz": system.loop.rate,
            "sensors": {
                sensor.name: sensor.model_dump(
                    mode="json",
                    include={
                        "photons",
                        "spot_fwhm",
                        "excess_noise",
                        "read_noise",
                        "pixels",
                        "pixel_scale",
                        "field_stop",
                        "noise_covariance",
                    },
                )
                for sensor in system.sensors
            },
        },
        **details,
        "versions": {
            "srtomo": own_version,
            "numpy": np.__version__,
            "scipy": scipy.__version__,
            "numba": numba.__version__,
        },
        "seconds": seconds,
    }


def believed_system(said: Mapping[str, Any], system: System) -> System:
    """The instrument with the sky and the light that a reconstructor was made for.

    Args:
        said: what :func:`provenance` made, as it comes back from a file.
        system: the instrument, whose fingerprint the reconstructor has.

    Raises:
        InstrumentError: it says no sky, or one that cannot be.
    """
    try:
        sensors = said["noise"]["sensors"]
        changes = {f"sensors.{w}.photons": sensors[sensor.name]["photons"] for w, sensor in enumerate(system.sensors)}
        changes["atmosphere"] = said["atmosphere"]
    except (KeyError, TypeError) as error:
        raise InstrumentError(f"provenance: {error} is missing") from None
    return system.with_changes(changes)


def reconstructor_of(
    system: System, R: Array, G: Array, *, method: str, label: str, gain: float, stages: Stages, **details: Any
) -> tuple[Reconstructor, Array]:
    """A method's last stage: R (n_commands, n_slopes) and G as a reconstructor for the system, and G.

    Other arguments as :func:`provenance` takes them.
    """
    stages.enter("done", 1.0)
    nominal = Layout(system)
    reconstructor = Reconstructor.from_matrices(
        R,
        G,
        fingerprint=nominal.fingerprint,
        gain=system.loop.gain,
        command_limit=nominal.stroke,
        label=label,
        provenance=provenance(system, method, gain, stages.seconds, **details),
    )
    return reconstructor, G
