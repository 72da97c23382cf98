"""Blocks whose photos stream from the disk: the same jobs and the same bytes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from small_plan import CONFIG, unseen

from clsplat.blocks.block import result_of
from clsplat.blocks.whole import plan_blocks, run_here
from clsplat.config import TrainConfig
from clsplat.dataset import load_scene
from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.streaming import StreamedView
from clsplat.training.preparation import prepare

TWO_PHOTOS = 2 * 3 * 40 * 32


def settings() -> TrainConfig:
    return replace(CONFIG, blocks=2, init=replace(CONFIG.init, triangulate=False, random_points=80))


def trained(dataset: Path, device: Device, out: Path, memory: int | None) -> tuple[list[str], list[bytes]]:
    config = settings()
    scene = load_scene(dataset, config.data, memory=memory)
    assert isinstance(scene.train[0], StreamedView) == (memory is not None)
    scene, config = prepare(dataset, config, device, scene=scene)
    jobs, _ = plan_blocks(scene, config, device, dataset, out, unseen, lambda text: None)
    run_here(jobs, scene, device, unseen)
    assert not list(out.rglob("*.npy")), "photos as a block sees them go with its training"
    return [job.name for job in jobs], [result_of(job).read_bytes() for job in jobs]


def test_blocks_of_photos_that_stream_have_the_same_bytes(dataset: Path, device: Device, tmp_path: Path) -> None:
    assert trained(dataset, device, tmp_path / "streamed", TWO_PHOTOS) == trained(
        dataset, device, tmp_path / "whole", None
    )


def test_a_changed_photo_ends_a_plan_that_goes_on(dataset: Path, device: Device, tmp_path: Path) -> None:
    config, data = settings(), tmp_path / "data"
    data.mkdir()
    for path in dataset.iterdir():
        (data / path.name).write_bytes(path.read_bytes())

    def plan() -> None:
        scene = load_scene(data, config.data, memory=TWO_PHOTOS)
        scene, prepared = prepare(data, config, device, scene=scene)
        plan_blocks(scene, prepared, device, data, tmp_path / "out", unseen, lambda text: None)

    plan()
    Image.fromarray(np.zeros((32, 40, 3), np.uint8)).save(data / "7.png")
    with pytest.raises(InputError, match="expected the photos of the coarse run, found other pixels or masks; start"):
        plan()
