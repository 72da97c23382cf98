"""Speed of the networks of the radiance fields, as a fraction of the device's multiply-adds per second."""

import time
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np

from clsplat import ops
from clsplat.device import Device

WIDTHS = ((32, 64, 16), (32, 64, 64, 16), (64,) * 5, (256,) * 5)
"""Networks that are timed: the two of Instant-NGP, and four layers of 64 and of 256."""

OPERATIONS = 1 << 30
"""Approximate number of multiply-adds of a forward pass, which sets its number of rows."""


def bench_networks(device: Device, repeats: int) -> list[dict[str, Any]]:
    """Time networks, forward and backward.

    Parameters
    ----------
    device : Device
    repeats : int
        Number of runs, of which the fastest counts, as for the roof.

    Returns
    -------
    list of dict
        widths, rows, and forward_gflops and backward_gflops: multiply-adds, each counted as two operations, in 1e9/s.
    """
    return [_bench(device, widths, repeats) for widths in WIDTHS]


def _bench(device: Device, widths: tuple[int, ...], repeats: int) -> dict[str, Any]:
    count = sum(a * b for a, b in pairwise(widths))
    rows, rng = max(1, OPERATIONS // count), np.random.default_rng(0)
    inputs, v_outputs = (device.upload("rows", rng.normal(size=(rows, w))) for w in (widths[0], widths[-1]))
    weights = device.upload("weights", rng.normal(size=count) / 8)
    _, hidden = ops.mlp_fwd(device, inputs, weights, widths)

    def fastest(run: Callable[[], Any]) -> float:
        seconds = []
        for _ in range(repeats + 1):  # the first run finishes kernels
            device.queue.finish()
            started = time.perf_counter()
            run()
            device.queue.finish()
            seconds.append(time.perf_counter() - started)
        return min(seconds[1:])

    forward = fastest(lambda: ops.mlp_fwd(device, inputs, weights, widths))
    backward = fastest(lambda: ops.mlp_bwd(device, inputs, weights, widths, hidden, v_outputs, widths[0]))
    rates = {"forward_gflops": 2e-9 * rows * count / forward, "backward_gflops": 4e-9 * rows * count / backward}
    return {"widths": list(widths), "rows": rows, **rates}
