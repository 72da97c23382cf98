"""Scenes on the disk: the files of an evaluation to the bit, from the rows that the photos may show."""

import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from clsplat.blocks import stored
from clsplat.blocks.stored import StoredScene
from clsplat.config import RenderConfig
from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.evaluate import evaluate, mean_metrics
from clsplat.formats import load_gaussians, save_gaussians
from clsplat.gaussians import Gaussians
from clsplat.render import renderings
from clsplat.renderer import Renderer
from clsplat.scene import View
from clsplat.testing import synthetic_scene

ROWS = 100
"""Rows of a part."""

APART = 1000.0
"""World units between two places: cameras see their own alone."""


@pytest.fixture(autouse=True)
def small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("clsplat.blocks.parts.PART", ROWS)


def places(count: int) -> tuple[Gaussians, list[View]]:
    """Places beside each other, each with two parts of Gaussians and a view of them alone."""
    parts, views = [], []
    for k in range(count):
        gaussians, camera = synthetic_scene(2 * ROWS, seed=k)
        moved = np.array([k * APART, 0, 0])
        parts.append(replace(gaussians, means=gaussians.means + moved))
        viewmat = camera.viewmat.copy()
        viewmat[:3, 3] -= viewmat[:3, :3] @ moved
        photo = np.random.default_rng(k).integers(0, 256, (camera.height, camera.width, 3), np.uint8)
        views.append(View(f"{k}.png", replace(camera, viewmat=viewmat, near=0.1), photo))
    return Gaussians.concatenate(parts).astype(np.float32), views


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(("most", "batches"), [(1e6, [4]), (6e4, [1, 1, 2]), (0, [1, 1, 1, 1])])
def test_an_evaluation_has_the_bits_of_the_whole_scene(
    device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most: float, batches: list[int]
) -> None:
    gaussians, views = places(3)
    views = [views[0], views[1], views[2], views[2]]
    save_gaussians(tmp_path / "scene.ply", gaussians, "antialiased")
    renderer = Renderer(device, RenderConfig("antialiased"), (0.2, 0.5, 0.1))
    whole, in_parts = load_gaussians(tmp_path / "scene.ply")[0], StoredScene(tmp_path / "scene.ply")
    monkeypatch.setattr(stored, "SHARE", most / device.memory_limit)
    assert [len(some) for some, _ in in_parts.shown(renderer, [view.camera for view in views])] == batches
    found = evaluate(in_parts, views, tmp_path / "in parts", renderer)
    assert found == evaluate(whole, views, tmp_path / "whole", renderer)
    assert found["num_gaussians"] == 600 and found["mean"]["psnr"] > 5
    assert contents(tmp_path / "in parts") == contents(tmp_path / "whole")


def test_a_camera_that_sees_nothing_has_the_background(device: Device, tmp_path: Path) -> None:
    gaussians, views = places(1)
    save_gaussians(tmp_path / "scene.ply", gaussians)
    away = replace(views[0].camera, viewmat=np.diag([-1.0, 1, -1, 1]) @ views[0].camera.viewmat)
    renderer, whole = Renderer(device, background=(0.2, 0.5, 0.1)), load_gaussians(tmp_path / "scene.ply")[0]
    (found,) = renderings(renderer, StoredScene(tmp_path / "scene.ply"), [away])
    (expected,) = renderings(renderer, whole, [away])
    np.testing.assert_array_equal(found.rgb, expected.rgb)


def test_the_memory_does_not_grow_with_the_scene(
    device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only the parts of a place are read for a view of it, and one place at a time is in memory."""
    gaussians, views = places(9)
    monkeypatch.setattr(stored, "BATCH", 1)
    renderer, peaks, read = Renderer(device), [], []
    original = stored.read_part
    monkeypatch.setattr(stored, "read_part", lambda folder, part: read.append(part) or original(folder, part))
    for count in (2, 2, 9):  # the first one imports modules
        path = tmp_path / f"{count}.ply"
        save_gaussians(path, gaussians.take(slice(count * 2 * ROWS)))
        tracemalloc.start()
        scene = StoredScene(path)
        read.clear()
        mean_metrics(scene, views[:count], renderer)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert len(read) == 2 * count
    place = 2 * ROWS * 4 * 59  # bytes of float32
    assert peaks[2] < peaks[1] + 2 * place


def test_a_changed_file_is_noticed(device: Device, tmp_path: Path) -> None:
    gaussians, views = places(1)
    path = tmp_path / "scene.ply"
    save_gaussians(path, gaussians)
    scene = StoredScene(path)
    gaussians.means[-1] += 1
    save_gaussians(path, gaussians)
    with pytest.raises(InputError, match=r"scene\.ply: expected a scene as it was written, found a changed file"):
        mean_metrics(scene, views, Renderer(device))
