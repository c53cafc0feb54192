"""An HRTC of ``mini`` whose interpreter is held: ``python held_interpreter.py compiled|rclpy RECONSTRUCTOR TURNS``.

Prints "ready"; from the first command on, in turns, the interpreter sleeps, and sits as long in a C call with its lock,
with a collection of many objects before and after. Prints what the loop did in all turns of each: "free" or "held",
seconds, frames answered and deadlines missed, and ends.
"""

import ctypes
import gc
import sys
import threading
import time
from pathlib import Path

import rclpy
from rclpy.node import Node

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_core.system import load_system
from srtomo_ops.simulate import program_of
from srtomo_rtc.hot import HotEndpoints
from srtomo_rtc.hrtc import Hrtc

SECONDS = 0.5  # of a turn

path, file, turns = sys.argv[1], Path(sys.argv[2]), int(sys.argv[3])
rclpy.init()
node = Node("hrtc_hot")
hot = HotEndpoints(node, 64, 64, compiled=path == "compiled")
system = load_system("mini")
layout = Layout(system)
deadline = (system.loop.delay - 1) / system.loop.rate  # as the node has it
hrtc = Hrtc(layout, system.loop.delay, hot.publish, deadline_ns=int(deadline * 1e9))
hrtc.loop.post(program_of(layout, Reconstructor.load(file)))
hrtc.loop.request(closed=True)
loop = threading.Thread(target=hot.run, args=(hrtc,))
loop.start()


def hold() -> None:
    gc.collect()
    rubbish.clear()
    ctypes.PyDLL(None).usleep(ctypes.c_uint(int(SECONDS * 1e6)))  # as PyDLL does not give the lock up
    gc.collect()


def now() -> list[float]:
    return [time.monotonic(), hrtc.counters.commands, hrtc.latency.misses]


print(f"ready: {hot.outcome}", flush=True)
while hrtc.counters.commands == 0:
    time.sleep(0.01)
found = {"free": [0.0] * 3, "held": [0.0] * 3}
rubbish: list[list[object]] = []
for _ in range(turns):
    for _ in range(100_000):
        one: list[object] = [None]
        one[0] = one  # only the collector can free it
        rubbish.append(one)
    for name, action in (("free", lambda: time.sleep(SECONDS)), ("held", hold)):
        before = now()
        action()
        found[name] = [a + b - c for a, b, c in zip(found[name], now(), before, strict=True)]
for name, (seconds, frames, misses) in found.items():
    print(f"{name} {seconds:.3f} {frames:.0f} {misses:.0f}", flush=True)
print("done", flush=True)
time.sleep(0.2)
hrtc.stopping = True
hot.wake()
loop.join()
hot.destroy()
node.destroy_node()
rclpy.shutdown()
