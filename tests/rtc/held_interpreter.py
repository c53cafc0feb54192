"""An HRTC of ``mini`` whose interpreter is held: ``python held_interpreter.py compiled|rclpy SECONDS``.

Prints "ready"; after the first command it holds the interpreter's lock in a C call, with a collection of many objects
before and after, prints the monotonic times of that (ns), and stops.
"""

import ctypes
import gc
import sys
import threading
import time

import rclpy
from rclpy.node import Node

from srtomo_core.layout import Layout
from srtomo_core.system import load_system
from srtomo_rtc.hot import HotEndpoints
from srtomo_rtc.hrtc import Hrtc

path, seconds = sys.argv[1], float(sys.argv[2])
rclpy.init()
node = Node("hrtc_hot")
hot = HotEndpoints(node, 64, 64, compiled=path == "compiled")
hrtc = Hrtc(Layout(load_system("mini")), 2.0, hot.publish)
loop = threading.Thread(target=hot.run, args=(hrtc,))
loop.start()
print(f"ready: {hot.outcome}", flush=True)
while hrtc.counters.commands == 0:
    time.sleep(0.01)
rubbish = []
for _ in range(300_000):
    one = [None]
    one[0] = one  # only the collector can free it
    rubbish.append(one)
before = time.monotonic_ns()
gc.collect()
rubbish.clear()
ctypes.PyDLL(None).usleep(ctypes.c_uint(int(seconds * 1e6)))  # as PyDLL does not give the lock up
gc.collect()
print(f"held from {before} to {time.monotonic_ns()}", flush=True)
time.sleep(0.2)
hrtc.stopping = True
hot.wake()
loop.join()
hot.destroy()
node.destroy_node()
rclpy.shutdown()
