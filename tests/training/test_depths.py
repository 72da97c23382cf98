"""Training with depth maps: from files to the scene, resumed, and its benefit with few photos."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_runs import fails, run, write_dataset
from PIL import Image
from scipy.ndimage import gaussian_filter
from small_run import SIZE, same

from clsplat import TrainConfig, prepare
from clsplat.bench.stability.small import CONFIG, known_gaussians, small_scene
from clsplat.camera import Camera
from clsplat.config import DataConfig, OptimConfig
from clsplat.dataset import load_scene
from clsplat.dataset.depth_maps import aligned
from clsplat.dataset.loading import read_depth_maps
from clsplat.dataset.near_planes import with_near_planes
from clsplat.demo.known_photos import known_scene
from clsplat.demo.ray_tracer import Solid, camera_rays, trace
from clsplat.demo.still_life import still_life
from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.formats import save_gaussians
from clsplat.gaussians import Gaussians
from clsplat.render import render
from clsplat.scene import DepthMap, Scene, View
from clsplat.training.corrections import depth_weight
from clsplat.training.few_views import adapted
from clsplat.training.loop import train


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset with points, and depth maps of its photos in 16 bits."""
    folder = tmp_path_factory.mktemp("data")
    truth = write_dataset(folder)
    (folder / "depth").mkdir()
    points = []
    for view in load_scene(folder, DataConfig(test_every=0)).train:
        rendering = render(truth, view.camera, device="reference", depth=True)
        surface = rendering.alpha > 0.9
        values = np.where(surface, 5000 / np.maximum(rendering.depth, 0.5) + 300, 0)
        Image.fromarray(values.astype(np.uint16)).save(folder / "depth" / view.name)
        v, u = np.argwhere(surface)[::5].T
        rays = view.camera.rays(u + 0.5, v + 0.5)
        seen = rays / rays[:, 2:] * rendering.depth[v, u][:, None] - view.camera.viewmat[:3, 3]
        points.append(seen @ view.camera.viewmat[:3, :3])
    means = np.concatenate(points)
    rows = truth.take(np.zeros(len(means), int))
    save_gaussians(folder / "points.ply", replace(rows, means=means.astype(np.float32)))
    text = (folder / "transforms.json").read_text()
    (folder / "transforms.json").write_text(text.replace("{", '{"ply_file_path": "points.ply", ', 1))
    (folder / "depth" / "0.png").unlink()  # of a photo that is held out
    return folder


OPTIONS = ("--iterations", 12, "--eval-every", 0, "--checkpoint-every", 6, "--depth", "depth", "--few.below", 0)


@pytest.mark.filterwarnings("ignore:--depth. . of 7 depth maps do not agree")  # translucent balls have no surface
def test_from_files_and_resumed(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The maps reach the training, whose bits are the same if it is interrupted, and no other command needs them."""
    run("train", data, "-o", tmp_path / "whole", *OPTIONS)
    assert "of inverse depths; once scaled, they differ from the points by" in capsys.readouterr().err
    without = [option for option in OPTIONS if option not in ("--depth", "depth")]
    run("train", data, "-o", tmp_path / "without", *without)
    scenes = [(tmp_path / name / "scene.ply").read_bytes() for name in ("whole", "without")]
    assert scenes[0] != scenes[1]

    config = TrainConfig(iterations=12, eval_every=0, checkpoint_every=6, data=DataConfig(depth="depth"))
    scene, config = prepare(data, replace(config, few=replace(config.few, below=0)))
    deep = [k for k, view in enumerate(scene.train) if view.depth]
    assert len(deep) > 2 and all(scene.train[k].depth.inverse for k in deep) and scene.test[0].depth is None

    def kill(record: dict[str, Any]) -> None:
        if record["iteration"] == 8:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        train(scene, config, tmp_path / "cut", progress=kill)
    assert same(train(scene, config, tmp_path / "cut", resume=True), train(scene, config, tmp_path / "again"))
    k = deep[1]
    one = scene.train[k]
    values = one.depth.values.copy()
    values[tuple(np.argwhere(np.isfinite(values))[0])] += 1
    other = replace(one, depth=replace(one.depth, values=values))
    with pytest.raises(InputError, match=rf"other depth maps \({one.name}\)"):
        train(
            replace(scene, train=[*scene.train[:k], other, *scene.train[k + 1 :]]),
            config,
            tmp_path / "cut",
            resume=True,
        )

    (data / "depth").rename(data / "moved")
    run("eval", tmp_path / "whole")
    (data / "moved").rename(data / "depth")


def test_what_a_mask_hides_has_no_depth(data: Path, tmp_path: Path) -> None:
    """A passer-by before the left half of each photo, whom the masks hide."""
    for name in "transforms.json", "points.ply":
        shutil.copy(data / name, tmp_path / name)
    for photo in data.glob("*.png"):
        shutil.copy(photo, tmp_path / photo.name)
        hidden = np.full(SIZE[::-1], 255, np.uint8)
        hidden[:, :20] = 0
        for folder in "masks", "nearer":
            (tmp_path / folder).mkdir(exist_ok=True)
        Image.fromarray(hidden).save(tmp_path / "masks" / photo.name)
        if (data / "depth" / photo.name).exists():
            values = np.array(Image.open(data / "depth" / photo.name))
            values[:, :20] = 60_000
            Image.fromarray(values).save(tmp_path / "nearer" / photo.name)
    found = {}
    for maps in data / "depth", tmp_path / "nearer":
        config = DataConfig(masks="masks", depth=str(maps))
        for memory in None, 0:  # in memory, and streamed from the disk
            scene = load_scene(tmp_path, config, memory=memory)
            found[maps, memory] = [view.depth.values for view in read_depth_maps(scene.train, tmp_path, config)]
    first, *others = found.values()
    assert all(np.isnan(values[:, :20]).all() and np.isfinite(values[:, 20:]).any() for values in first)
    for other in others:
        np.testing.assert_array_equal(other, first)


def test_refusals_name_the_file(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "neither" in fails(capsys, "train", data, "-o", tmp_path / "a", "--depth", "nowhere")
    kept = (data / "depth" / "4.png").read_bytes()
    (data / "depth" / "4.png").unlink()
    assert "depth map of photo 4.png" in fails(capsys, "train", data, "-o", tmp_path / "b", *OPTIONS)
    np.save(data / "depth" / "4.npy", np.ones((SIZE[0], SIZE[1])))
    assert "4.npy: expected a depth map with the aspect" in fails(
        capsys, "train", data, "-o", tmp_path / "c", *OPTIONS
    )
    (data / "depth" / "4.npy").unlink()
    (data / "depth" / "4.png").write_bytes(kept)
    message = fails(capsys, "train", data, "-o", tmp_path / "e", "--method", "plenoxels", "--depth", "depth")
    assert "found depth" in message


def with_true_maps(scene: Scene, device: Device, change: Callable[[Any], Any]) -> Scene:
    """Maps of the surface, changed, in the photos of a scene; unknown where there is none."""

    def mapped(view: View) -> View:
        seen = render(known_gaussians(), view.camera, device=device, depth=True)
        values = np.where(seen.alpha > 0.5, seen.depth, np.nan)
        return replace(view, depth=DepthMap(change(values).astype(np.float32)))

    return replace(scene, train=[mapped(view) for view in scene.train])


def true_depths(camera: Camera, solids: list[Solid]) -> Any:
    """Depths (H, W) of the still life; NaN where there is only sky."""
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = camera_rays(camera, u.ravel(), v.ravel())
    distances, _ = trace(camera.position[:, None], rays, solids)
    depths = (distances * (camera.viewmat[2, :3] @ rays)).reshape(v.shape)
    return np.where(np.isfinite(depths), depths, np.nan)


def estimated(view: View, solids: list[Solid], rng: np.random.Generator) -> View:
    """A map as of a network: inverse depths with smooth errors, of another scale and shift in each photo."""
    exact = 1 / true_depths(view.camera, solids)
    noise = gaussian_filter(rng.normal(size=exact.shape), 6)
    values = rng.uniform(500, 2000) * exact * (1 + 0.03 * noise / noise.std()) + rng.uniform(-300, 300)
    return replace(view, depth=DepthMap(values.astype(np.float32)))


def depth_error(gaussians: Gaussians, scene: Scene, solids: list[Solid], device: Device) -> float:
    """Mean over held-out photos of the median error of the depths, as a fraction, where a surface is drawn."""
    errors = []
    for view in scene.test:
        found, truth = render(gaussians, view.camera, device=device, depth=True), true_depths(view.camera, solids)
        surface = np.isfinite(truth) & (found.alpha > 0.5)
        errors.append(np.median(np.abs(found.depth / truth - 1)[surface]))
    return float(np.mean(errors))


def test_few_photos_gain_by_depth_maps(device: Device, tmp_path: Path) -> None:
    """Six photos around the still life, in which many arrangements of Gaussians look right."""
    solids, rng = still_life(), np.random.default_rng(0)
    scene = known_scene(24, 80, 60, points=400)
    scene = replace(scene, train=scene.train[::4])
    deep = aligned(replace(scene, train=[estimated(view, solids, rng) for view in scene.train]))
    errors = []
    for some in map(with_near_planes, (scene, deep)):
        config = adapted(TrainConfig(iterations=600, eval_every=0), some)
        errors.append(depth_error(train(some, config, tmp_path, device), some, solids, device))
    # Measured: 0.064 and 0.046.
    assert errors[1] < 0.85 * errors[0]


@pytest.mark.parametrize("mode", ["exposure", "poses", "ray", "coarse", "filter_3d"])
def test_maps_work_with_other_settings(device: Device, tmp_path: Path, mode: str) -> None:
    """The term changes the result, and the loss includes it."""
    scene = small_scene(device)
    deep = with_true_maps(scene, device, lambda z: z)
    config = replace(CONFIG, iterations=6)
    if mode in ("exposure", "poses", "filter_3d"):
        config = replace(config, **{mode: True})
    elif mode == "ray":
        config = replace(config, render=replace(config.render, projection="ray"))
    else:
        config = replace(config, coarse=replace(config.coarse, factor=2))
    losses: list[list[float]] = [[], []]
    for s, found in zip((scene, deep), losses, strict=True):
        train(s, config, tmp_path, device, progress=lambda record, found=found: found.append(record["loss"]))
    assert losses[1][0] > losses[0][0] and np.isfinite(losses).all()


def test_the_weight_falls() -> None:
    config = OptimConfig(depth_weight=2.0, depth_weight_final=0.02)
    np.testing.assert_allclose([depth_weight(p, config) for p in (0, 0.5, 1)], [2, 0.2, 0.02])
