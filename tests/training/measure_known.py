"""PSNR of fixed sizes on photos of known Gaussians: the plateaus of test_autosize.py. A few minutes."""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from test_autosize import GROWING, held_out, known_scene

from clsplat.device import Device
from clsplat.training.loop import train

COPIES = 8

if __name__ == "__main__":
    device = Device()
    for count in (64, 128, 256):
        scene = known_scene(count, device, copies=COPIES)
        order = np.random.default_rng(1).permutation(len(scene.points))
        for factor in (2**-0.5, 1, 2**0.5, 2, 2**1.5, 4, 8):
            rows = order[: int(factor * count)]
            fewer = replace(scene, points=scene.points[rows], colors=scene.colors[rows])
            with tempfile.TemporaryDirectory() as folder:
                config = replace(GROWING, size="fixed", max_gaussians=len(rows))
                gaussians = train(fewer, config, Path(folder), device)
            print(f"{count} known, {len(gaussians)} trained: {held_out(gaussians, scene, device):.2f} dB", flush=True)
