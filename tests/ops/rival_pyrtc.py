"""pyRTC's POLC integrators on matrices of ours, in a Python that has it: ``python rival_pyrtc.py PROBLEM.npz``.

For every line ``INTEGRATOR FRAMES OUT.npz`` on standard input it runs so many frames, paced, and answers with a line.
Each frame is timed from when its slopes are due to the command's being in its shared memory, but for the writing of the
slopes. Streams, construction and warm-up are
those of its own benchmark of first iterations.
"""

import sys
import time
import uuid

import numpy as np
import pyshmem
from pyrtc.loop import Loop

SPIN_NS = 200_000  # before a frame; sleeping on would be late


def wait_until(due_ns: int) -> int:
    """Wait for a time of the monotonic clock; the time it then is, or ``due_ns`` if that was past already."""
    left = due_ns - time.monotonic_ns()
    if left <= 0:
        return due_ns
    if left > SPIN_NS:
        time.sleep((left - SPIN_NS) * 1e-9)
    while (now := time.monotonic_ns()) < due_ns:
        pass
    return now


def main() -> None:
    """Serve until standard input ends."""
    with np.load(sys.argv[1]) as problem:
        R, G, slopes = (np.ascontiguousarray(problem[name], np.float32) for name in ("R", "G", "slopes"))
        gain, rate = float(problem["gain"]), float(problem["rate"])
    n_commands, n_slopes = R.shape
    tag = uuid.uuid4().hex[:8]
    signal = pyshmem.create(f"signal_{tag}", shape=(n_slopes,), dtype=np.float32)
    wfc = pyshmem.create(f"wfc_{tag}", shape=(n_commands,), dtype=np.float32)
    loop = Loop(
        {
            "input_streams": {"signal": signal.name},
            "output_streams": {"wfc": wfc.name},
            "functions": [],
            "gain": gain,
            "p_gain": gain,
            "leaky_gain": gain,
        }
    )
    try:
        # its sign: the correction is taken from the pseudo-open-loop slopes, and the product from the correction
        loop.im = -G
        loop.compute_cm()
        loop.cm[:] = -R
        loop.gain = gain
        loop.warmup()
        print("ready", flush=True)
        frame = 0
        for line in sys.stdin:
            integrator, frames, out = line.split()
            step = getattr(loop, integrator)
            taken, commands, first = [], [], wfc.read().copy()
            start = time.monotonic_ns() + round(1e9 / rate)
            for i in range(int(frames)):
                begun = wait_until(start + round(i * 1e9 / rate))
                writing = time.monotonic_ns()
                signal.write(slopes[frame % len(slopes)])
                begun += time.monotonic_ns() - writing  # the sensor's work
                step()
                taken.append(time.monotonic_ns() - begun)
                commands.append(wfc.read().copy())
                frame += 1
            np.savez(out, taken=taken, commands=commands, first=first, frame=frame - int(frames))
            print("done", flush=True)
    finally:
        loop.close()
        for stream in (signal, wfc):
            stream.close()
            stream.unlink()


if __name__ == "__main__":
    main()
