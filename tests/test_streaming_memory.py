"""Memory of a training whose photos stream from the disk: it does not grow with the number of photos."""

import gc
import json
import tracemalloc
import weakref
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_runs import SIZE, write_dataset
from PIL import Image
from small_run import CONFIG

from clsplat.config import DataConfig, InitConfig
from clsplat.dataset import load_scene
from clsplat.device import Device
from clsplat.evaluate import mean_metrics
from clsplat.metrics import psnr
from clsplat.renderer import Renderer
from clsplat.scene import View
from clsplat.streaming import PhotoStream
from clsplat.testing import synthetic_scene
from clsplat.training.contributions import contributions
from clsplat.training.loop import train

PHOTO = 3 * SIZE[0] * SIZE[1]

IN_MEMORY = 4
"""Photos that fit the memory of a stream."""


def peak(count: int, device: Device, tmp_path: Path) -> int:
    """Bytes that Python and NumPy take at most in a load, a training, a survey and an evaluation of photos."""
    width, height = 5 * SIZE[0], 5 * SIZE[1]
    folder = tmp_path / str(count)
    write_dataset(folder, count)
    intrinsics = json.loads((folder / "transforms.json").read_text())
    larger = {name: 5 * intrinsics[name] for name in ("fl_x", "fl_y", "cx", "cy", "w", "h")}
    (folder / "transforms.json").write_text(json.dumps(intrinsics | larger))
    for k in range(count):
        pixels = np.random.default_rng(k).integers(0, 256, (height, width, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(folder / f"{k}.png", compress_level=1)
    gaussians = synthetic_scene(40, seed=4)[0]
    gc.collect()
    tracemalloc.start()
    scene = load_scene(folder, DataConfig(), memory=IN_MEMORY * 3 * width * height)
    init = InitConfig(triangulate=False, random_points=80, sh_degree=1)
    config = replace(CONFIG, strategy="error", max_gaussians=120, iterations=90, checkpoint_every=7, init=init)
    train(scene, config, folder / "out", device)
    assert len(contributions(Renderer(device), gaussians, scene.train).errors) == 40
    mean_metrics(gaussians, scene.train, Renderer(device), (psnr,))
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return most


@pytest.fixture
def most_photos(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The largest number of decoded photos that were alive at once, in a list."""
    alive: list[weakref.ref[Any]] = []
    most = [0]
    decode = PhotoStream._read

    def read(self: PhotoStream, name: str) -> View:
        view = decode(self, name)
        alive.append(weakref.ref(view.image))
        most[0] = max(most[0], sum(each() is not None for each in alive))
        return view

    monkeypatch.setattr(PhotoStream, "_read", read)
    return most


def test_memory_does_not_grow_with_the_photos(
    device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most_photos: list[int]
) -> None:
    """The 80 photos more would take 7.7 MB; their names, cameras, digests and records take 10 kB each."""
    # A photo's differences in float64 take 2 MB, and threads decide how many of them there are at once.
    monkeypatch.setattr("clsplat.evaluate.PENDING", 0)
    peak(3, device, tmp_path)  # modules are loaded, programs are built
    limit = peak(10, device, tmp_path) + 40 * 25 * PHOTO  # half of them
    # Threads that other tests have left may allocate meanwhile, but hardly in both.
    assert any(peak(90, device, tmp_path / again) < limit for again in ("first", "second"))
    assert most_photos[0] <= 2 * IN_MEMORY, "beside those of the stream, some are in use"
