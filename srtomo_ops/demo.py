"""The whole loop over ROS 2: plant, HRTC, SRTC and recorder as processes, with a swap half way.

The loop opens on a reconstructor that supposes all turbulence at the ground. Half way the right profile's takes over.
Everything is prepared before frame 0, and frame 0 goes out when HRTC and recorder have reported themselves matched.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from rclpy.signals import SignalHandlerOptions
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from srtomo_core.system import System
from srtomo_ops.commands.calibrate import calibrate
from srtomo_ops.operator import Operator, OperatorError
from srtomo_ops.processes import Processes
from srtomo_ops.report import demo_figure
from srtomo_sim.sky import strehl

BEFORE, AFTER = "ground", "file"
"""The priors of the two reconstructors."""

_WHY = {
    BEFORE: "poor prior: all turbulence at the ground",
    AFTER: "right profile: the instrument file's layers",
}
_SETTLING = 0.2  # s left out of the statistics after a start or a swap
_PREPARE_TIMEOUT = 600.0  # s
_PRIORITY = 40  # SCHED_FIFO of HRTC and plant, where the system lets us
_SCIENCE_RATE = 100.0  # Hz at which the wavefront error is looked at


@dataclass
class _Screen:
    """What the display shows."""

    system: System
    frames: int
    stage: str = ""
    active: str = "none"
    note: str = ""

    def render(self, operator: Operator) -> Group:
        """The display as it stands."""
        table = Table(show_header=False, box=None, padding=(0, 2))
        sim, hrtc, recorder = operator.sim, operator.hrtc, operator.recorder
        if sim is not None and sim.rate > 0:
            table.add_row("frame", f"{sim.frame + 1} of {self.frames}", f"{sim.rate:.0f} Hz")
            table.add_row(
                "wavefront error",
                f"{sim.wfe * 1e9:.0f} nm",
                f"tip-tilt {sim.wfe_tip_tilt * 1e9:.0f} nm, Strehl {sim.strehl:.2f} at {sim.wavelength * 1e9:.0f} nm",
            )
        if hrtc is not None and hrtc.commands:
            table.add_row(
                "latency",
                f"{hrtc.latency_p50 * 1e6:.0f} us",
                f"p99 {hrtc.latency_p99 * 1e6:.0f} us, {hrtc.deadline_misses} deadline misses",
            )
        table.add_row("reconstructor", self.active, _WHY.get(self.active, ""))
        if recorder is not None and recorder.frames:
            table.add_row("recorded", f"{recorder.frames} frames", f"{recorder.lost} messages lost")
        return Group(Text(f"srtomo demo: {self.system.name} - {self.stage}"), table, Text(self.note))

    def line(self, operator: Operator) -> str:
        """The display in a line, for what is not a terminal."""
        sim, hrtc = operator.sim, operator.hrtc
        if sim is None or hrtc is None or sim.rate <= 0:
            return self.stage
        return (
            f"frame {sim.frame + 1}/{self.frames}  {sim.rate:.0f} Hz  "
            f"WFE {sim.wfe * 1e9:.0f} nm  Strehl {sim.strehl:.2f}  "
            f"latency {hrtc.latency_p50 * 1e6:.0f}/{hrtc.latency_p99 * 1e6:.0f} us  {self.active}"
        )


class Demo:
    """One run of the demo.

    Args:
        system: the instrument, changes applied.
        name, changes: how the nodes are to load it.
        seconds: of loop.
        seed: of sky, noise and jitter.
        folder: for the bag, the figure and the nodes' logs; exists.
        console: to show progress on.
    """

    def __init__(
        self, system: System, name: str, changes: dict[str, Any], seconds: float, seed: int, folder: Path,
        console: Console,
    ) -> None:  # fmt: skip
        self._system = system
        self._name = name
        self._changes = changes
        self._frames = max(20, round(seconds * system.loop.rate))
        self._seconds = seconds
        self._seed = seed
        self._folder = folder
        self._console = console
        self._screen = _Screen(system, self._frames)
        self._shown = 0.0

    def run(self) -> dict[str, Any]:
        """Run it; the numbers of ``--json``.

        Raises:
            NodeError, OperatorError: a node ended, refused or did not answer.
        """
        # rclpy's own handlers end the context under the call that Ctrl-C interrupts
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        operator = Operator(name="demo")
        try:
            with Processes(self._folder) as nodes, self._live() as live:
                self._nodes, self._operator, self._display = nodes, operator, live
                self._start_nodes()
                swap_frame = self._run_loop()
                report = self._end()
        finally:
            operator.destroy_node()
            rclpy.shutdown()
        return self._numbers(swap_frame, report)

    def _live(self) -> Live:
        return Live(console=self._console, refresh_per_second=4, transient=True, auto_refresh=False)

    def _show(self, stage: str | None = None) -> None:
        if stage is not None and stage != self._screen.stage:
            self._screen.stage = stage
        now = time.monotonic()
        if self._console.is_terminal:
            if now - self._shown > 0.25:
                self._shown = now
                self._display.update(self._screen.render(self._operator), refresh=True)
        elif now - self._shown > 2.0:
            self._shown = now
            self._console.print(self._screen.line(self._operator), highlight=False)

    def _until(self, condition: Callable[[], bool], stage: Callable[[], str], timeout: float, failure: str) -> None:
        end = time.monotonic() + timeout
        while not condition():
            self._nodes.check()
            if time.monotonic() > end:
                raise OperatorError(f"{failure} in {timeout:g} s")
            self._show(stage())
            self._operator.spin(0.05)

    def _start_nodes(self) -> None:
        folder, nodes, operator = self._folder, self._nodes, self._operator
        matrix = folder / "interaction_matrix.npz"
        self._show("calibrating the interaction matrix")
        calibrate(self._system, matrix)
        every = max(1, round(self._system.loop.rate / _SCIENCE_RATE))

        def start(command: str, *parameters: str) -> None:
            words = ["-p", *[word for p in parameters for word in ("-p", p)][1:]] if parameters else []
            sets = [word for key, value in self._changes.items() for word in ("--set", f"{key}={json.dumps(value)}")]
            nodes.start(command, [command, self._name, *sets, *words])

        start("srtc", f"priors:=[{BEFORE},{AFTER}]")
        start(
            "sim",
            f"frames:={self._frames}",
            f"seed:={self._seed}",
            f"science_every:={every}",
            f"result:={folder / 'wfe.npz'}",
        )
        # sky and reconstructors first: they take all there is of the machine
        self._until_service("srtc/publish", "srtc")
        self._until_service("sim/start", "sim")
        start(
            "hrtc",
            f"interaction_matrix:={matrix}",
            f"fifo_priority:={_PRIORITY}",
            # a machine shared with others may stall for a while: that should be seen in the figures, not open the loop
            f"fault_budget:={round(self._system.loop.rate)}",
        )
        sets = [word for key, value in self._changes.items() for word in ("--set", f"{key}={json.dumps(value)}")]
        nodes.start(
            "recorder",
            ["record", self._name, *sets, "-o", str(folder / "bag"), "--json", str(folder / "recorder.json")],
        )
        self._show("configuring the HRTC")
        operator.transition("configure")
        operator.transition("activate")
        self._until(
            lambda: operator.hrtc is not None and operator.recorder is not None
            and operator.hrtc.slope_publishers > 0 and operator.hrtc.command_readers >= 2
            and operator.recorder.slope_publishers > 0 and operator.recorder.command_publishers > 0,
            lambda: "waiting for HRTC and recorder to find everybody",
            60.0,
            "HRTC and recorder did not find everybody",
        )  # fmt: skip
        self._commit(BEFORE)
        operator.close_loop(True)

    def _until_service(self, service: str, node: str) -> None:
        from msgs_schema.srv import PublishReconstructor
        from std_srvs.srv import Trigger

        kind = Trigger if service == "sim/start" else PublishReconstructor
        client = self._operator.create_client(kind, service)
        what = "preparing the sky" if node == "sim" else f"building reconstructors '{BEFORE}' and '{AFTER}'"
        self._until(
            client.service_is_ready,
            lambda: ": ".join(filter(None, (what, self._nodes.last_line(node).rpartition("]: ")[2][-60:]))),
            _PREPARE_TIMEOUT,
            f"{node} was not ready",
        )
        self._operator.destroy_client(client)

    def _commit(self, label: str) -> int:
        identity, sha256 = self._operator.publish(label)
        self._operator.wait_staged(identity)
        first = self._operator.commit(identity, sha256)
        self._screen.active = label
        self._screen.note = f"frame {first}: reconstructor {identity:016x}, {_WHY[label]}"
        if not self._console.is_terminal:
            self._console.print(self._screen.note, highlight=False)
        return first

    def _run_loop(self) -> int:
        operator, half = self._operator, self._frames // 2
        # the plant stands for hardware, which would not wait for a core either
        self._nodes.prioritise("sim", _PRIORITY)
        operator.start_sim()
        started = time.monotonic()
        patience = 4 * self._seconds + 30

        def frame() -> int:
            return operator.sim.frame if operator.sim is not None else 0

        self._until(lambda: frame() >= half, lambda: "running", patience, "the plant did not reach half way")
        swap_frame = self._commit(AFTER)
        self._until(lambda: frame() >= self._frames - 1, lambda: "running", patience, "the plant did not end")
        self._elapsed = time.monotonic() - started
        return swap_frame

    def _end(self) -> dict[str, Any]:
        operator, nodes = self._operator, self._nodes
        recorder = operator.recorder
        self._show("finishing the bag")
        end = time.monotonic() + 10
        while time.monotonic() < end and (recorder is None or recorder.frames < self._frames):
            operator.spin(0.2)
            recorder = operator.recorder
        operator.spin(0.3)
        self._hrtc = operator.hrtc
        nodes.stop("recorder")
        for name in ("sim", "hrtc", "srtc"):
            nodes.stop(name)
        report: dict[str, Any] = json.loads((self._folder / "recorder.json").read_text())
        return report

    def _numbers(self, swap_frame: int, report: dict[str, Any]) -> dict[str, Any]:
        wavelength = self._system.science.wavelength
        with np.load(self._folder / "wfe.npz") as result:
            frame, high_order, uncorrected = result["frame"], result["high_order"][:, 0], result["uncorrected"][:, 0]
            slipped, late = float(result["slipped"]), int(result["late_commands"])
        settling = _SETTLING * self._system.loop.rate
        before = (frame >= settling) & (frame < swap_frame)
        after = frame >= swap_frame + settling
        if not before.any() or not after.any():
            raise OperatorError(f"--seconds: too short, the swap came at frame {swap_frame} of {self._frames}")
        figure = self._folder / "demo.png"
        demo_figure(
            figure, self._system, frame, high_order, swap_frame, self._folder / "bag", (_WHY[BEFORE], _WHY[AFTER])
        )
        hrtc = self._hrtc
        assert hrtc is not None

        def rms(values: Any) -> float:
            return float(np.sqrt(np.mean(values**2))) * 1e9

        return {
            "system": self._system.name,
            "rate_hz": self._frames / (self._frames / self._system.loop.rate + slipped),
            "seconds": self._frames / self._system.loop.rate,
            "frames": self._frames,
            "frames_answered": hrtc.commands,
            "frames_recorded": report["frames"],
            "frames_lost": self._frames - report["frames"],
            "messages_lost": report["lost"],
            "swaps": 1,
            "swap_frame": swap_frame,
            "wfe_nm_open": rms(uncorrected),
            "wfe_nm_before": rms(high_order[before]),
            "wfe_nm_after": rms(high_order[after]),
            "strehl_before": float(strehl(high_order[before], wavelength).mean()),
            "strehl_after": float(strehl(high_order[after], wavelength).mean()),
            "science_wavelength_m": wavelength,
            "latency_us": {
                "p50": hrtc.latency_p50 * 1e6,
                "p99": hrtc.latency_p99 * 1e6,
                "p999": hrtc.latency_p999 * 1e6,
                "max": hrtc.latency_max * 1e6,
            },
            "deadline_misses": hrtc.deadline_misses,
            "loop_opened_by_faults": hrtc.loop_opened_by_faults,
            "realtime": hrtc.realtime,
            "late_commands": late,
            "slipped_s": slipped,
            "bag": str(self._folder / "bag"),
            "figure": str(figure),
        }


def summary(numbers: dict[str, Any]) -> Table:
    """The table that the demo ends with."""
    latency = numbers["latency_us"]
    nominal = numbers["frames"] / numbers["seconds"]
    rate = f"{numbers['rate_hz']:.1f} Hz"
    if numbers["slipped_s"] > 0:
        rate += f" (asked for {nominal:g}: this machine fell {numbers['slipped_s']:.2f} s behind)"
    table = Table(title=f"srtomo demo: {numbers['system']}", show_header=False, title_justify="left")
    for name, value in (
        ("frame rate", rate),
        ("frames", f"{numbers['frames']} published, {numbers['frames_answered']} answered, "
                   f"{numbers['frames_recorded']} recorded, {numbers['frames_lost']} lost"),
        ("WFE, no correction", f"{numbers['wfe_nm_open']:.0f} nm"),
        ("WFE before the swap",
         f"{numbers['wfe_nm_before']:.1f} nm, Strehl {numbers['strehl_before']:.3f}: {_WHY[BEFORE]}"),
        ("WFE after the swap",
         f"{numbers['wfe_nm_after']:.1f} nm, Strehl {numbers['strehl_after']:.3f}: {_WHY[AFTER]}"),
        ("swap", f"at frame {numbers['swap_frame']}"),
        ("latency", f"p50 {latency['p50']:.0f}, p99 {latency['p99']:.0f}, p99.9 {latency['p999']:.0f}, "
                    f"max {latency['max']:.0f} us, last slopes to command"),
        ("deadline misses", str(numbers["deadline_misses"])),
        ("loop", f"opened by itself {numbers['loop_opened_by_faults']} times: too many frames held in a row"
                 if numbers["loop_opened_by_faults"] else "closed throughout"),
        ("settings", numbers["realtime"]),
        ("late commands", f"{numbers['late_commands']} (the plant held its mirror)"),
        ("bag", numbers["bag"]),
        ("figure", numbers["figure"]),
    ):  # fmt: skip
        table.add_row(name, value)
    return table
