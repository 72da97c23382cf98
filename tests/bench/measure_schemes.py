"""Time both schemes of the stage bin, for the table of docs/stages/bin.md."""

import time

import numpy as np

from clsplat import ops
from clsplat.bench.workloads import synthetic
from clsplat.device import Device
from clsplat.renderer import Renderer

NAMES = ["10k-640x480", "10k-1280x720", "100k-640x480", "100k-1280x720", "1M-640x480", "1M-1280x720"]
TILE_SIZE = 16
ROUNDS = 15


def measure(device, splats, width, height):
    """Medians of alternating runs by (scheme, gradients): wall time, and processor time per core, ms."""
    kinds = [(scheme, gradients) for scheme in ("global", "per_tile") for gradients in (True, False)]
    cores = device.cl_device.max_compute_units if device.is_cpu else 1
    times = {kind: [] for kind in kinds}
    for _ in range(ROUNDS + 1):
        for kind in kinds:
            device.queue.finish()
            wall, cpu = time.perf_counter(), time.process_time()
            ops.bin_splats(device, splats, width, height, TILE_SIZE, scheme=kind[0], gradients=kind[1])
            device.queue.finish()
            times[kind].append((time.perf_counter() - wall, (time.process_time() - cpu) / cores))
    return {kind: 1e3 * np.median(values[1:], axis=0) for kind, values in times.items()}


def main():
    device = Device()
    print(f"{device.label}; ms: wall (processor / cores)")
    print("| | intersections | global | without gradients | per_tile | without gradients |")
    print("|---|---|---|---|---|---|")
    for name in NAMES:
        workload = synthetic(name)
        camera, gaussians = workload.view.camera, Renderer(device).place(workload.gaussians)
        splats = ops.project_fwd(device, gaussians, camera, 0)
        m = ops.bin_splats(device, splats, camera.width, camera.height, TILE_SIZE).gauss_ids.shape[0]
        cells = [
            f"{wall:.2f} ({cpu:.2f})" for wall, cpu in measure(device, splats, camera.width, camera.height).values()
        ]
        print(f"| {name} | {m / 1e6:.2f} M | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
