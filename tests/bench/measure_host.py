"""Processor time of the main thread in a training step, for docs/howto/devices.md.

That of kernels does not count, nor does waiting for them.
"""

import time

import numpy as np

from clsplat.bench.timing import ITERATION, training_of
from clsplat.bench.workloads import synthetic
from clsplat.config import TrainConfig
from clsplat.device import Device

# The host takes the same calls for many Gaussians as for few, but larger kernels on its own cores empty their caches.
NAMES = ["2k-32x24", "8k-128x128"]
WARM_UP, STEPS = 20, 200


def measure(training):
    """Processor times of the main thread in steps, ms."""
    times = []
    for _ in range(WARM_UP + STEPS):
        training.device.queue.finish()
        training.state.iteration = ITERATION - 1
        begin = time.thread_time()
        training.advance()
        times.append(time.thread_time() - begin)
    return 1e3 * np.array(times[WARM_UP:])


def main():
    device = Device()
    print(f"{device.label}, kernels for {'CPUs' if device.is_cpu else 'GPUs'}; ms per step")
    print("| | least | median |")
    print("|---|---|---|")
    for name in NAMES:
        times = measure(training_of(synthetic(name), TrainConfig(), device))
        print(f"| {name} | {times.min():.2f} | {np.median(times):.2f} |", flush=True)


if __name__ == "__main__":
    main()
