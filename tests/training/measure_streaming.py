"""Memory and time to the first iteration of a training whose photos stream, and of one with all in memory.

Usage: python tests/training/measure_streaming.py [COUNT ...]

Writes datasets of COUNT JPEGs of 600 x 450 pixels (default: 100 and 300) into a temporary folder, and trains each for
`ITERATIONS` in a process of its own: once with `MEMORY` for the photos, once with all in memory. Prints the
processor time and the wall time from the start of loading to the end of the first iteration, and the largest resident
size of the process.
"""

import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

WIDTH, HEIGHT = 600, 450
MEMORY = 25_000_000
ITERATIONS = 300


def write_photos(folder: Path, count: int) -> None:
    """A ring of cameras, and photos of blurred noise, which compresses about as photos do."""
    from clsplat.camera import Camera

    frames = []
    rng = np.random.default_rng(0)
    for k in range(count):
        angle = 2 * np.pi * k / count
        camera = Camera.look_at(
            [3 * np.sin(angle), -1, 3 * np.cos(angle)], [0, 0, 0], [0, -1, 0], 1000, WIDTH, HEIGHT
        )
        matrix = np.linalg.inv(camera.viewmat) @ np.diag([1, -1, -1, 1])
        frames.append({"file_path": f"{k:04}.jpg", "transform_matrix": matrix.tolist()})
        noise = Image.fromarray(rng.integers(0, 256, (HEIGHT // 4, WIDTH // 4, 3), dtype=np.uint8))
        noise.resize((WIDTH, HEIGHT), Image.Resampling.BICUBIC).save(folder / f"{k:04}.jpg", quality=90)
    lens = {"fl_x": 1000, "fl_y": 1000, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT}
    (folder / "transforms.json").write_text(json.dumps(lens | {"frames": frames}))


def measure(folder: Path, count: int, memory: int) -> None:
    """Train; runs in a process of its own."""
    from clsplat.config import DataConfig, InitConfig, TrainConfig
    from clsplat.dataset import load_scene
    from clsplat.device import Device
    from clsplat.training.loop import train

    device = Device()
    init = InitConfig(triangulate=False, random_points=2000, sh_degree=0)
    config = TrainConfig(iterations=ITERATIONS, size="fixed", max_gaussians=2000, eval_every=0, init=init)
    started = time.process_time(), time.perf_counter()
    first: list[float] = []

    def progress(record: dict[str, Any]) -> None:
        if not first:
            first.extend((time.process_time() - started[0], time.perf_counter() - started[1]))

    train(
        load_scene(folder, DataConfig(test_every=0), memory=memory), config, folder / "out", device, progress=progress
    )
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    end = time.process_time() - started[0]
    print(
        f"{count} photos, {memory / 1e6:.0f} MB for them: first iteration after {first[0]:.2f} s of processor time "
        f"({first[1]:.2f} s), end after {end:.1f} s; peak {peak:.0f} MB",
        flush=True,
    )


def main() -> None:
    if sys.argv[1:2] == ["--child"]:
        measure(Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]))
        return
    for memory in (MEMORY, 10**12):
        for count in map(int, sys.argv[1:] or ("100", "300")):
            with tempfile.TemporaryDirectory() as folder:
                write_photos(Path(folder), count)
                subprocess.run(
                    [sys.executable, "-P", __file__, "--child", folder, str(count), str(memory)], check=True
                )


if __name__ == "__main__":
    main()
