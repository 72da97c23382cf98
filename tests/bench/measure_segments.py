"""Time compositing on a GPU with tiles, batches and segments of several sizes, for the table of docs/gpu.md.

The first numbers of a row are the edge of a tile, the splats of a batch and those of a segment (cl/composite_gpu.cl).
"""

import sys
from itertools import product

from clsplat.bench.kernels import bench_workload
from clsplat.bench.workloads import synthetic
from clsplat.config import RenderConfig
from clsplat.device import Device
from clsplat.ops import composite

NAMES = ["100k-640x480", "1M-640x480", "1M-1920x1080"]
TILES, BATCHES, SEGMENTS = (8, 16), (32, 64), (32, 64, 128, 256)
REPEATS = 5


def main():
    device = Device()
    print(f"{device.label}; ms")
    print("| tile, batch, segment | workload | intersections | step | bin | composite forward | backward |")
    print("|---|---|---|---|---|---|---|")
    # Both passes take batches of this size here.
    for tile, batch, segment in product(TILES, BATCHES, SEGMENTS):
        composite.GPU_STAGED, composite.GPU_BATCH, composite.SEGMENT = batch, batch, segment
        for name in sys.argv[1:] or NAMES:
            found = bench_workload(synthetic(name), RenderConfig(tile_size=tile), device, REPEATS)
            times = [found["stages"][s]["median_ms"] for s in ("bin_splats", "composite_fwd", "composite_bwd")]
            cells = [f"{found['counts']['intersections'] / 1e6:.2f} M", *(f"{t:.2f}" for t in times)]
            cells.insert(1, f"{found['step']['median_ms']:.2f}")
            print(f"| {tile}, {batch}, {segment} | {name} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
