"""A soak: sensors, HRTC and recorder as processes, as fast as they go, with swaps and faults, for very many frames.

The recording is split into files. Each is checked when it is finished, and then deleted: a million frames of a large
instrument would fill a disk. Nothing here is paced: the rate is what the machine gives.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import save_interaction_matrix
from srtomo_core.system import System
from srtomo_core.wire import COMMAND, SLOPES
from srtomo_ops.bench.soak_check import TOLERANCE, Check, SoakError
from srtomo_ops.bench.soak_plan import Fault, Matrices, Plan
from srtomo_ops.processes import Processes

LEAK = 0.1
"""Of the loop: random slopes would otherwise add up in it."""

FLAT_BYTES_A_FRAME = 16
"""Growth of a process that still counts as none: anything that is kept of a frame is more."""

FLAT_BYTES = 8 << 20
"""As above, for short runs: what an allocator may take for itself."""

_CONTRAST = 5.0  # in TOLERANCEs: the least by which a mixture of two reconstructors has to stand out
_SAMPLE_PERIOD = 0.5  # s
_LEAST_SAMPLES = 16
_FILLED = 100_000  # frames after which several reconstructors have come and gone, and queues are full
_WARM = 0.25  # of the run, left out where memory is looked at
_NODES = ("hrtc", "recorder", "sensors")


class Memory(NamedTuple):
    """Resident memory of a process, bytes.

    Attributes:
        growth: over the run, by the slope of a straight line through all but its beginning; None if the run was too
            short to tell.
    """

    first: int
    last: int
    largest: int
    growth: float | None

    @classmethod
    def of(cls, times: list[float], sizes: list[int], frames: int) -> Memory:
        """Of samples of a run of so many frames."""
        t, size = np.array(times), np.array(sizes, np.float64)
        late = t >= t[0] + max(_WARM, _FILLED / frames) * (t[-1] - t[0])
        growth = None
        if late.sum() >= _LEAST_SAMPLES:
            growth = float(np.polyfit(t[late], size[late], 1)[0] * (t[-1] - t[0]))
        return cls(sizes[0], sizes[-1], max(sizes), growth)

    def flat(self, frames: int) -> bool:
        """Whether that is no growth."""
        return self.growth is None or self.growth <= max(FLAT_BYTES, FLAT_BYTES_A_FRAME * frames)


@dataclass(frozen=True)
class Soak:
    """What was found; that it exists means that nothing was wrong with any command or record.

    Attributes:
        seconds: from the first frame to the last command.
        swaps: of the reconstructor.
        transfers: reconstructors that were sent and checked meanwhile, and may have been used.
        refused: bad reconstructors, all refused.
        faults: frames with each.
        verdicts: commands with each.
        error: largest difference of a command from float64, of the largest of its frame.
        contrast: see :meth:`~srtomo_ops.bench.soak_check.Check.contrast`.
        files, bytes: recorded, checked and deleted.
        messages: recorded.
        memory: of each process.
        latency: s, hrtc/status: p50, p99, p999, max.
    """

    frames: int
    seconds: float
    swaps: int
    transfers: int
    refused: int
    faults: dict[str, int]
    verdicts: dict[str, int]
    error: float
    contrast: float
    files: int
    bytes: int
    messages: int
    from_ring: int
    memory: dict[str, Memory]
    latency: dict[str, float]

    @property
    def flat(self) -> bool:
        """Whether no process grew."""
        return all(one.flat(self.frames) for one in self.memory.values())


class _Sampler(threading.Thread):
    """Reads the processes' memory now and then; on a thread of its own, as checking a file takes seconds."""

    def __init__(self, nodes: Processes) -> None:
        super().__init__(name="memory", daemon=True)
        self._nodes, self._over = nodes, threading.Event()
        self.times: list[float] = []
        self.sizes: dict[str, list[int]] = {name: [] for name in _NODES}

    def run(self) -> None:
        """The thread's body."""
        while True:
            try:
                sizes = [self._nodes.resident_bytes(name) for name in _NODES]
            except (OSError, KeyError):  # one has ended: somebody else will say so
                return
            self.times.append(time.monotonic())
            for name, size in zip(_NODES, sizes, strict=True):
                self.sizes[name].append(size)
            if self._over.wait(_SAMPLE_PERIOD):
                return

    def stop(self) -> None:
        """End it; a short run has one sample at least."""
        self._over.set()
        if not self.ident:
            self.start()
        self.join()


def soak(
    system: System,
    name: str,
    changes: Mapping[str, Any],
    frames: int,
    folder: Path,
    swap_every: int = 1000,
    split_mb: float = 500.0,
    seed: int = 0,
    progress: Callable[[float], None] = lambda done: None,
) -> Soak:
    """Run it, in the ROS domain that is set.

    Args:
        system: the instrument, with ``changes``; ``name`` and ``changes`` are how the nodes are to load it.
        folder: for matrices, recording and the nodes' logs; exists.
        swap_every: frames from one swap of the reconstructor to the next.
        split_mb: size of a file of the recording, MB.
        progress: called with the share of frames that were checked.

    Raises:
        ValueError: something that must not happen did.
    """
    layout = Layout(system)
    plan = Plan.of(layout, frames, seed)
    matrices = Matrices.of(system, layout, seed)
    matrices.save(folder)
    save_interaction_matrix(folder / "gcal.npz", matrices.G, layout.fingerprint, {"source": "soak"})
    check = Check(plan, system.loop.delay, LEAK, matrices.good)
    sets = [word for key, value in changes.items() for word in ("--set", f"{key}={json.dumps(value)}")]
    with Processes(folder) as nodes:
        parameters = [f"interaction_matrix:={folder / 'gcal.npz'}", f"reconstructor:={folder / 'good_0.npz'}"]
        # no other kernel is as near to float64
        parameters += [f"leak:={LEAK}", "kernel:=float32"]
        nodes.start("hrtc", ["hrtc", name, *sets, *(word for p in parameters for word in ("-p", p))])
        bag = folder / "bag"
        report = folder / "recorder.json"
        words = ["-o", str(bag), "--split", str(split_mb), "--json", str(report)]
        nodes.start("recorder", ["record", name, *sets, *words])
        drive = [str(folder), name, json.dumps(dict(changes)), str(frames), str(seed), str(swap_every)]
        nodes.start("sensors", drive, "srtomo_ops.bench.soak_drive")
        sampler = _Sampler(nodes)
        files = _Files(bag, check)
        begun, told_file = folder / "begun", folder / "told.json"
        while not told_file.exists():
            nodes.check()
            progress(check.frames / frames)
            if not sampler.ident and begun.exists():
                sampler.start()
            if not files.check_finished():
                time.sleep(0.1)
        sampler.stop()
        # the recorder first: what the others say when they end is not part of it
        for node in ("recorder", "sensors", "hrtc"):
            code = nodes.stop(node)
            if code not in ((0, 1) if node == "recorder" else (0,)):
                raise SoakError(f"{node} ended with exit code {code}: {nodes.last_line(node)}")
    while files.check_next():
        progress(check.frames / frames)
    check.finish()
    told, recorded = json.loads(told_file.read_text()), json.loads(report.read_text())
    _compare("hrtc/status", told["status"], check.expected_counters())
    _compare("hrtc/status", told["status"], {"reconstructors_refused": told["refused"]})
    _compare_records(recorded, check)
    announced = in_force([(0, matrices.good[0].id), *map(tuple, told["swaps"])], frames)
    if check.swaps != announced:
        made, said = set(check.swaps), set(announced)
        raise SoakError(
            f"changes of reconstructor, (first frame, id): made but not told {sorted(made - said)[:3]}, "
            f"told but not made {sorted(said - made)[:3]}"
        )
    contrast = check.contrast()
    if contrast < _CONTRAST * TOLERANCE:
        raise SoakError(f"a mixture might differ by {contrast:.1e} only: it would not have been noticed")
    status = told["status"]
    return Soak(
        frames,
        told["seconds"],
        len(check.swaps) - 1,
        told["transfers"],
        told["refused"],
        {fault.name.lower(): int(np.sum(plan.faults == fault)) for fault in Fault if fault},
        {verdict.name.lower(): n for verdict, n in sorted(check.verdicts.items())},
        check.error,
        contrast,
        files.count,
        recorded["bytes"],
        recorded["messages"],
        recorded["from_ring"],
        {node: Memory.of(sampler.times, sizes, frames) for node, sizes in sampler.sizes.items()},
        {key: status[f"latency_{key}"] for key in ("p50", "p99", "p999", "max")},
    )


def in_force(told: Iterable[tuple[int, int]], frames: int) -> list[tuple[int, int]]:
    """First frame and id of the reconstructors that made commands of ``frames`` frames, of all that swaps told.

    Of two swaps between the same two frames, which a machine that stands still brings about, the later one counts; what
    was to make no frame, made none.
    """
    found: list[tuple[int, int]] = []
    for frame, reconstructor in dict(told).items():
        if frame < frames and not (found and found[-1][1] == reconstructor):
            found.append((frame, reconstructor))
    return found


class _Files:
    """The files of a recording, which are checked and deleted one after the other."""

    def __init__(self, bag: Path, check: Check) -> None:
        self._bag, self._check = bag, check
        self.count = 0

    def _file(self, number: int) -> Path:
        return self._bag / f"{self._bag.name}_{number}.mcap"

    def check_finished(self) -> bool:
        """The next file, if the recorder has begun another one since."""
        return self._file(self.count + 1).exists() and self.check_next()

    def check_next(self) -> bool:
        """The next file, if there is one."""
        file = self._file(self.count)
        if not file.exists():
            return False
        self._check.read(file)
        file.unlink()
        self.count += 1
        return True


def _compare(who: str, found: Mapping[str, Any], wanted: Mapping[str, int]) -> None:
    for name, value in wanted.items():
        if found[name] != value:
            raise SoakError(f"{who}: {name} is {found[name]}, expected {value}")


def _compare_records(recorded: dict[str, Any], check: Check) -> None:
    """The recorder's own report against what was sent."""
    wanted = check.expected_records()
    topics = {name: next(t for t in recorded["topics"] if t.endswith(name)) for name in (SLOPES.name, COMMAND.name)}
    slopes, commands = (recorded["topics"][topics[name]] for name in (SLOPES.name, COMMAND.name))
    found = {
        **recorded,
        "slopes": slopes["recorded"],
        "commands": commands["recorded"],
        "lost": slopes["lost"] + commands["lost"],
        "duplicates": slopes["duplicates"],
    }
    _compare("recorder", found, wanted)


def lines(found: Soak, system: System) -> list[str]:
    """For people."""
    wrong = ", ".join(f"{n} {name.replace('_', ' ')}" for name, n in found.faults.items())
    rate = found.frames / found.seconds
    shown = [
        f"{system.name}: {found.frames} frames in {found.seconds:.0f} s, {rate:.0f} a second, "
        f"{found.swaps} swaps, {found.transfers} reconstructors sent meanwhile, {found.refused} bad ones refused",
        f"faults: {wrong}",
        "every frame has one command, in order, made by one reconstructor alone: within "
        f"{found.error:.1e} of float64, where another's part would show as {found.contrast:.1e}",
        f"recorded: {found.messages} messages, none lost, {found.bytes / 1e9:.2f} GB in {found.files} files, "
        "each checked and then deleted",
        "latency, us: " + ", ".join(f"{name} {value * 1e6:.0f}" for name, value in found.latency.items()),
        f"{'memory, MiB':<14}{'first':>9}{'largest':>9}{'last':>9}{'growth over the run':>22}",
    ]
    for name, memory in found.memory.items():
        sizes = "".join(f"{size / 2**20:9.1f}" for size in (memory.first, memory.largest, memory.last))
        growth = "   too short to tell"
        if memory.growth is not None:
            verdict = "flat" if memory.flat(found.frames) else "GROWS"
            growth = f"{memory.growth / 2**20:9.2f}, {memory.growth / found.frames:.1f} bytes a frame: {verdict}"
        shown.append(f"  {name:<12}{sizes}{growth}")
    return shown


def numbers(found: Soak) -> dict[str, Any]:
    """For ``--json``."""
    return {
        **{name: value for name, value in vars(found).items() if name != "memory"},
        "memory": {name: memory._asdict() for name, memory in found.memory.items()},
        "flat": found.flat,
        "lost": 0,
    }
