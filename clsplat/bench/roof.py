"""Measurement of the device's limits, to which `clsplat bench kernels` relates its times."""

import time
from collections.abc import Callable

from clsplat.device import Device

CHAINS = 16
"""Number of independent values per work-item, as in cl/roof.cl."""

GPU_GROUP = 256
"""Work-items of a group on GPUs, if these run so many."""

BUFFER_BYTES = 512 * 2**20
"""Size of each buffer for bandwidth, bytes, if memory permits. It exceeds the caches of all devices, except for a few
CPUs whose last level holds part of it."""

MEMORY_SHARE = 16
"""Ratio of the device's memory to the largest size of a buffer."""

SECONDS = 0.02
"""Shortest time of a measured run, s: about a thousand times that of a launch."""

RUNS = 5
"""Number of runs, of which the fastest counts: a limit is what an undisturbed run reaches."""

LAUNCHES = 1000
"""Number of launches of the empty kernel in a row."""


def _best(device: Device, run: Callable[[], None], runs: int) -> float:
    """Time of the fastest run, s, after a first one that builds the kernel and touches the memory."""
    seconds = []
    for _ in range(runs + 1):
        start = time.perf_counter()
        run()
        device.queue.finish()
        seconds.append(time.perf_counter() - start)
    return min(seconds[1:])


def defines(device: Device, width: int) -> dict[str, int]:
    """Defines of cl/roof.cl for vectors of the given width."""
    return {"WIDTH": width, "HALVES": int(device.vector_width < width)}


def _arithmetic(device: Device, kernel: str, *scalars: float) -> float:
    """Number of results per second."""
    # CPU cores are fastest with wide vectors, GPUs with many scalar work-items.
    width, group = (16, 1) if device.is_cpu else (1, device.group(GPU_GROUP))
    items = (4 if device.is_cpu else 2048) * device.cl_device.max_compute_units
    out = device.empty("roof", items * width)

    def run() -> None:
        device.launch(
            "roof", kernel, (items,), [rounds, *scalars, out], defines=defines(device, width), group=(group,)
        )

    rounds = 64
    while _best(device, run, 1) < SECONDS:
        rounds *= 4
    return items * width * CHAINS * rounds / _best(device, run, RUNS)


def _bandwidth(device: Device, kernel: str, buffers: int, *scalars: float) -> tuple[float, int]:
    """Bytes read and written per second, and the size of each buffer, bytes."""
    width, group = (16, 1) if device.is_cpu else (4, device.group(GPU_GROUP))
    items = (4 if device.is_cpu else 2048) * device.cl_device.max_compute_units
    limit = min(BUFFER_BYTES, device.cl_device.global_mem_size // MEMORY_SHARE, device.cl_device.max_mem_alloc_size)
    count = int(limit // (items * width * device.real.itemsize))
    arrays = [device.empty("roof", items * count * width) for _ in range(buffers)]
    for array in arrays:
        array.fill(0)
    arguments = [count, 1 if device.is_cpu else items, *scalars, *arrays]

    def run() -> None:
        device.launch("roof", kernel, (items,), arguments, defines=defines(device, width), group=(group,))

    return buffers * arrays[0].nbytes / _best(device, run, RUNS), arrays[0].nbytes


def measure_roof(device: Device) -> dict[str, float]:
    """Measure the device's limits, in a second or two.

    Returns
    -------
    dict
        fma_gflops: multiply-adds, each counted as two operations, in 1e9/s; exp_gops, exp2_gops: 1e9/s; copy_gbs,
        triad_gbs: 1e9 bytes/s read and written; buffer_mib: size of each of their buffers; launch_us: time of an
        empty kernel and of waiting for it; queued_launch_us: time of one of many empty kernels in a row.
    """
    out = device.empty("roof", 64)

    def launch() -> None:
        device.launch("roof", "roof_empty", (1,), [out], defines=defines(device, 1), group=(1,))

    def queued() -> None:
        for _ in range(LAUNCHES):
            launch()

    def waiting() -> None:
        for _ in range(LAUNCHES):
            launch()
            device.queue.finish()

    copy, size = _bandwidth(device, "roof_copy", 2)
    triad, _ = _bandwidth(device, "roof_triad", 3, 0.5)
    return {
        # x -> 0.999 x + 0.001 converges to 1.
        "fma_gflops": 2e-9 * _arithmetic(device, "roof_fma", 0.999, 0.001),
        "exp_gops": 1e-9 * _arithmetic(device, "roof_exp"),
        "exp2_gops": 1e-9 * _arithmetic(device, "roof_exp2"),
        "copy_gbs": 1e-9 * copy,
        "triad_gbs": 1e-9 * triad,
        "buffer_mib": size / 2**20,
        "launch_us": 1e6 * _best(device, waiting, RUNS) / LAUNCHES,
        "queued_launch_us": 1e6 * _best(device, queued, RUNS) / LAUNCHES,
    }
