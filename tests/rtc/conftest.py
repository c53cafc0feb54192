"""The HRTC without ROS: fed by a sensor that sees its commands, and recorded as the node and its recorder would."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from srtomo_core import wire
from srtomo_core.bag import BagWriter
from srtomo_core.layout import Layout
from srtomo_core.messages import encode
from srtomo_core.reconstructor import LowOrder, Reconstructor, block_table
from srtomo_core.system import load_system
from srtomo_core.wire import SlopeFrameWriter, read_dm_command
from srtomo_rtc.events import EventKind, change_fields, state_fields
from srtomo_rtc.hrtc import Hrtc
from srtomo_rtc.loop import Settings
from srtomo_rtc.swap import Manifest, Swap
from srtomo_sim.mirror import interaction_matrix

SESSION = 2**63 + 5
PERIOD = 5_000_000  # ns


@pytest.fixture(scope="session")
def mini():
    """``mini``: system, layout, G, and reconstructors a, b and c that pass every check of a swap; c can do without
    lasers."""
    system = load_system("mini")
    layout = Layout(system)
    G = interaction_matrix(system, layout)

    def reconstructor(regularisation: float, label: str) -> Reconstructor:
        R = np.linalg.solve(G.T @ G + regularisation * np.eye(layout.n_commands), G.T)
        return Reconstructor.from_matrices(
            R, G, fingerprint=layout.fingerprint, gain=0.5, command_limit=layout.stroke, label=label
        )

    scale = np.linalg.norm(G, 2) ** 2

    def closable(regularisation: float) -> Reconstructor:
        """One that has R for each laser alone being closed, and the low order of the natural star."""

        def least_squares(closed: int) -> np.ndarray:
            seen = G.copy()
            for w in range(len(layout.sensors)):
                if closed >> w & 1:
                    seen[layout.slopes_of(w)] = 0
            return np.linalg.solve(seen.T @ seen + regularisation * np.eye(layout.n_commands), seen.T)

        x, y = layout.mirrors[0].actuators.T
        tilts = np.stack([x, y]) * 1e-7
        natural = np.zeros((2, layout.n_slopes))
        natural[:, layout.slopes_of(3)] = np.linalg.inv(G[layout.slopes_of(3)] @ tilts.T)
        return Reconstructor.from_matrices(
            least_squares(0), G, fingerprint=layout.fingerprint, gain=0.5, command_limit=layout.stroke, label="c",
            closures={closed: least_squares(closed) for closed in (0b1, 0b10, 0b100)},
            low_order=LowOrder(tilts, natural),
        )  # fmt: skip

    return SimpleNamespace(
        system=system,
        layout=layout,
        G=G.astype(np.float32),
        a=reconstructor(3e-3 * scale, "a"),
        b=reconstructor(1e-2 * scale, "b"),
        c=closable(1e-2 * scale),
    )


def plain_settings(layout: Layout, **changes) -> Settings:
    zeros = {"offset": np.zeros(layout.n_commands, "f4"), "slope_reference": np.zeros(layout.n_slopes, "f4")}
    return Settings(**{"id": 1, **zeros, **changes})


def manifest_of(reconstructor: Reconstructor, **changes) -> Manifest:
    fields = {
        "sha256": reconstructor.sha256,
        "fingerprint": reconstructor.fingerprint,
        "n_commands": reconstructor.n_commands,
        "n_slopes": reconstructor.n_slopes,
        "n_epochs": reconstructor.n_epochs,
        "n_blocks": len(block_table(reconstructor.n_commands, reconstructor.n_epochs, len(reconstructor.closures))),
        "gain": reconstructor.gain,
        "slope_reference": reconstructor.slope_reference,
        "command_limit": reconstructor.command_limit,
        "probe_commands": reconstructor.probe_commands.ravel(),
        "probe_slopes": reconstructor.probe_slopes.ravel(),
        "label": reconstructor.label,
        "closed_sensors": tuple(closure.sensors for closure in reconstructor.closures),
    }
    if reconstructor.low_order is not None:
        fields["low_order_commands"] = reconstructor.low_order.commands.ravel()
        fields["low_order_slopes"] = reconstructor.low_order.slopes.ravel()
    return Manifest(**{**fields, **changes})


def blocks_of(reconstructor: Reconstructor) -> list[wire.ReconstructorBlock]:
    return [
        wire.ReconstructorBlock(reconstructor.id, reconstructor.sha256, *vars(block).values())
        for block in reconstructor.blocks()
    ]


class Sky:
    """Slopes of the turbulence and what the mirror takes off them, by the definition of the delay."""

    def __init__(self, layout: Layout, G, delay: float, seed: int = 1) -> None:
        self._layout, self._G, self._delay, self._seed = layout, np.asarray(G, float), delay, seed
        self.shown: dict[int, np.ndarray] = {}

    def slopes(self, k: int) -> np.ndarray:
        own = np.random.default_rng([self._seed, k]).standard_normal(self._layout.n_slopes) * 1e-7
        slow = np.random.default_rng(self._seed).standard_normal(self._layout.n_slopes) * 1e-6
        newest, before, share = self.timing(k)
        flat = np.zeros(self._layout.n_commands)
        shape = share * self.shown.get(newest, flat) + (1 - share) * self.shown.get(before, flat)
        return (own + slow * math.cos(0.02 * k) - self._G @ shape).astype(np.float32)

    def timing(self, k: int) -> tuple[int, int, float]:
        whole = math.floor(self._delay)
        newest, before = (frame if frame in self.shown else -1 for frame in (k - whole, k - whole - 1))
        return newest, before, 1 - (self._delay - whole)


class Bench:
    """An Hrtc and its Swap, on one thread; everything that comes and goes is recorded if a bag is given."""

    def __init__(self, mini, bag: Path | None = None, delay: float = 2.0, session: int = SESSION, **options) -> None:
        self.mini, self.layout, self.session = mini, mini.layout, session
        self.delay = delay
        self.now = 10**15
        self.commands: list[wire.DmCommand] = []
        self.sent: list[bytes] = []
        self.labels: dict[int, EventKind] = {}
        self._writer = None if bag is None else BagWriter(bag, {"system": mini.system.model_dump_json()})
        self._kernel = options.pop("kernel", "float32")
        self._system = options.pop("system", mini.system)
        self._options = options
        self.configure()

    def configure(self) -> None:
        """A new Hrtc, as after a restart; the sensors run on."""
        self.sky = Sky(self.layout, self.mini.G, self.delay)
        self.hrtc = Hrtc(self.layout, self.delay, self._publish, **self._options)
        self.hrtc.start()
        settings = plain_settings(self.layout)
        epochs = self.hrtc.loop.max_epochs
        post = self.hrtc.loop.post
        self.swap = Swap(self._system, self.layout, self.mini.G, settings, post, epochs, self._kernel)

    # -- sensors ----------------------------------------------------------------------------------------------------

    def messages(self, k: int, slopes=None, session: int | None = None, fingerprint: bytes | None = None, timing=None):
        """One message a sensor of frame ``k``."""
        slopes = self.sky.slopes(k) if slopes is None else slopes
        made = []
        for w, sensor in enumerate(self.layout.sensors):
            writer = SlopeFrameWriter(
                sensor.name,
                self.session if session is None else session,
                self.layout.fingerprint if fingerprint is None else fingerprint,
                w,
                1,
                sensor.n_valid,
            )
            writer.values[:] = slopes[self.layout.slopes_of(w)]
            made.append(writer.write(self.now, k, *(timing or self.sky.timing(k))))
        return made

    def packet(
        self, k: int, sensor: int, first: int, count: int, n_sensors: int = 1, slopes=None, timing=None
    ) -> bytes:
        """Part of one sensor, or several whole ones, written by another implementation of CDR."""
        slopes = self.sky.slopes(k) if slopes is None else slopes
        if n_sensors == 1:
            own = slopes[self.layout.slopes_of(sensor)].reshape(2, -1)[:, first : first + count].ravel()
        else:
            own = slopes[self.layout.slope_start[sensor] : self.layout.slope_start[sensor + n_sensors]]
            count = len(own) // 2
        newest, before, share = timing or self.sky.timing(k)
        return encode(
            wire.SLOPES.type,
            header={"stamp": {"sec": self.now // 10**9, "nanosec": self.now % 10**9}, "frame_id": "packet"},
            session=self.session, frame=k, fingerprint=np.frombuffer(self.layout.fingerprint, np.uint8), sensor=sensor,
            n_sensors=n_sensors, first_subaperture=first, n_subapertures=count, mirror_frame=newest,
            mirror_frame_before=before, mirror_fraction=share, slopes=own,
        )  # fmt: skip

    # -- as the node does -------------------------------------------------------------------------------------------

    def offer(self, *messages: bytes, recorded: bool = True) -> None:
        """What is taken in one go, then answered."""
        for message in messages:
            self.now += 1000
            if recorded:
                self._record(wire.SLOPES, message)
            self.hrtc.offer(message, self.now)
        self.hrtc.advance()
        self.hrtc.idle(self.now)

    def frame(self, k: int, slopes=None) -> None:
        """A frame's slopes, sensor by sensor."""
        self.now += PERIOD
        for message in self.messages(k, slopes):
            self.offer(message)
        self.tell()

    def run(self, frames, each: Callable[[int], None] = lambda k: None) -> None:
        for k in frames:
            each(k)
            self.frame(k)

    def publish(self, reconstructor: Reconstructor) -> None:
        """As the SRTC does, on the wire; staged."""
        manifest = manifest_of(reconstructor)
        fields = {**vars(manifest), "id": manifest.id}
        for name in ("sha256", "fingerprint"):
            fields[name] = np.frombuffer(fields[name], np.uint8)
        self._record(wire.RECONSTRUCTOR, encode(wire.RECONSTRUCTOR.type, **fields))
        for block in blocks_of(reconstructor):
            self._record(wire.RECONSTRUCTOR_BLOCK, wire.write_block(block))
        self.swap.stage_whole(reconstructor)

    def commit(self, reconstructor: Reconstructor) -> None:
        self.labels[id(self.swap.commit(reconstructor.id, reconstructor.sha256))] = EventKind.COMMIT

    def roll_back(self, reconstructor: Reconstructor) -> None:
        self.labels[id(self.swap.roll_back(reconstructor.id, reconstructor.sha256))] = EventKind.ROLLBACK

    def close_sensors(self, *sensors: int) -> None:
        """These sensors are closed from the next frame on, and no others."""
        self.swap.change_settings(closed_sensors=sum(1 << w for w in sensors))
        self.hrtc.idle(self.now)  # the loop's thread is woken

    def dark(self, k: int, *sensors: int) -> np.ndarray:
        """Slopes of frame ``k``, but what some sensors send is no number."""
        slopes = self.sky.slopes(k)
        for w in sensors:
            slopes[self.layout.slopes_of(w)] = np.nan
        return slopes

    def close(self, reconstructor: Reconstructor) -> None:
        """Commit a reconstructor and close the loop."""
        self.publish(reconstructor)
        self.commit(reconstructor)
        self.hrtc.loop.request(closed=True)

    def tell(self) -> None:
        """Publish changes and snapshots."""
        while not self.hrtc.changes.empty():
            change = self.hrtc.changes.get()
            kind = self.labels.get(id(change.program), EventKind.SETTINGS)
            if change.what != "PROGRAM":
                kind = EventKind[change.what]
            fields = change_fields(change, kind, change.reason, self.hrtc.loop.delay)
            fields["sha256"] = np.array(fields.get("sha256", np.zeros(32)), np.uint8)
            stamp = {"stamp": {"sec": self.now // 10**9, "nanosec": self.now % 10**9}}
            self._record(wire.EVENT, encode(wire.EVENT.type, header=stamp, **fields))
        while not self.hrtc.snapshots.empty():
            fields = state_fields(self.hrtc.snapshots.get())
            fields["sha256"] = np.array(fields.get("sha256", np.zeros(32)), np.uint8)
            self._record(wire.STATE, encode(wire.STATE.type, **fields))

    def finish(self) -> None:
        self.tell()
        if self._writer is not None:
            self._writer.close()

    def _publish(self, buffer: bytes) -> None:
        command = read_dm_command(buffer)
        self.commands.append(command)
        self.sent.append(buffer)
        self.sky.shown[command.frame] = command.commands.astype(float)
        self._record(wire.COMMAND, buffer)

    def _record(self, topic: wire.Topic, data: bytes) -> None:
        if self._writer is not None:
            self._writer.write(f"/{topic.name}", topic.type, data, self.now, self.now)


@pytest.fixture(scope="session")
def bench(mini):
    """Makes a Bench, of ``mini`` or of another instrument made like it; a recorded one is for ``finish`` to close."""
    return lambda of=mini, **options: Bench(of, **options)


@pytest.fixture(scope="session")
def helpers():
    """Functions for building what travels."""
    return SimpleNamespace(manifest_of=manifest_of, blocks_of=blocks_of, plain_settings=plain_settings, Sky=Sky)
