"""One meaning of a configuration: Python's three lines and `clsplat train` write the same bytes."""

# ruff: noqa: F811 (fixtures are imported and then named as arguments)
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_runs import run, write_dataset
from PIL import Image
from test_brightness import alternating, scene_of
from test_triangulation import POINTS_TARGET, posed, write_transforms  # noqa: F401  (a fixture)

from clsplat import TrainConfig, prepare, save_gaussians, train
from clsplat.config import DataConfig, FewViewsConfig, InitConfig
from clsplat.dataset import load_scene
from clsplat.errors import InputError
from clsplat.evaluate import evaluate
from clsplat.gaussians import Gaussians
from clsplat.scene import View
from clsplat.training.preparation import open_device
from clsplat.training.presets import load_preset


def from_python(data: Path, config: TrainConfig, out: Path) -> bytes:
    scene, config = prepare(data, config)
    gaussians = train(scene, config, out)
    save_gaussians(out / "scene.ply", gaussians, config.render.mode, scene.offset)
    return (out / "scene.ply").read_bytes()


def test_eight_photos(tmp_path: Path) -> None:
    """Fewer than `few.below`: the configuration is adapted to them."""
    write_dataset(tmp_path / "data", 8)
    run("train", tmp_path / "data", "-o", tmp_path / "command", "--iterations", 30, "--init.random-points", 300)
    config = TrainConfig(iterations=30, init=InitConfig(random_points=300))
    found = from_python(tmp_path / "data", config, tmp_path / "python")
    assert found == (tmp_path / "command" / "scene.ply").read_bytes()
    scene, adapted = prepare(tmp_path / "data", config)
    assert len(scene.train) == 7 and adapted.dropout > 0 == config.dropout
    plain = train(scene, replace(config, size="fixed", strategy="adc"), tmp_path / "plain")
    save_gaussians(tmp_path / "plain.ply", plain)
    assert found != (tmp_path / "plain.ply").read_bytes(), "the adaptation must matter"


def test_poses_without_points(posed: list[View], tmp_path: Path) -> None:
    path = write_transforms(tmp_path, posed)
    options = ("--iterations", 5, "--test-every", 0, "--max-gaussians", 500)
    run("train", path, "-o", tmp_path / "command", *options)
    config = TrainConfig(iterations=5, max_gaussians=500, data=DataConfig(test_every=0))
    assert from_python(path, config, tmp_path / "python") == (tmp_path / "command" / "scene.ply").read_bytes()
    # The points are triangulated again when a run resumes, and must be the same.
    run("train", path, "-o", tmp_path / "command", *options, "--resume")
    told: list[str] = []
    scene, _ = prepare(path, config, tell=told.append)
    assert len(scene.points) == POINTS_TARGET and f"start: {POINTS_TARGET} points, from photos and poses" in told[1]


def test_photos_brighter_than_those_next_to_them_are_evened_out(tmp_path: Path) -> None:
    """Unless each photo's exposure is learned, or the presets of papers are used."""
    scene = scene_of(np.exp(alternating()))
    told: list[str] = []
    found, _ = prepare(tmp_path, TrainConfig(iterations=5), scene=scene, tell=told.append)
    assert found.gains.keys() == {view.name for view in scene.train}
    assert any(text.startswith("brightness: training photos differ from those taken next to them") for text in told)
    for config in (TrainConfig(even_brightness=False), TrainConfig(exposure=True), load_preset("paper-7k")):
        assert not prepare(tmp_path, replace(config, iterations=5), scene=scene)[0].gains


def test_photos_that_are_reduced_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_dataset(tmp_path / "data", 8)
    config = TrainConfig(iterations=5, init=InitConfig(random_points=300))
    told: list[str] = []
    width = prepare(tmp_path / "data", config, tell=told.append)[0].train[0].camera.width
    assert not any("reduced" in line for line in told)
    monkeypatch.setattr("clsplat.dataset.finding.SCREEN", 320)
    scene, _ = prepare(tmp_path / "data", config, tell=told.append)
    camera = scene.train[0].camera
    assert camera.width * scene.downscale == width
    size = f"{camera.width}x{camera.height}"
    assert f"photos: {size} pixels, reduced by 2 (--downscale chooses another size)" in told
    told.clear()
    prepare(tmp_path / "data", replace(config, data=DataConfig(downscale=2)), tell=told.append)
    assert not any("reduced" in line for line in told), "it was asked for"


@pytest.mark.parametrize("below", [17, 3])
def test_the_points_of_few_photos_limit_the_gaussians(below: int, posed: list[View], tmp_path: Path) -> None:
    """The size is not searched with as few photos, whether or not the settings for fewer still apply."""
    config = TrainConfig(data=DataConfig(test_every=0), few=FewViewsConfig(below=below))
    few = prepare(write_transforms(tmp_path, posed), config)[1]
    assert few.size == "fixed" and few.max_gaussians is not None


def test_poses_without_points_are_evaluated_as_they_were_trained(
    posed: list[View], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The near planes of held-out photos follow the points that training triangulates, in later commands, too."""
    nears = []

    def noted(gaussians: Gaussians, views: list[View], *others: Any) -> dict[str, Any]:
        nears.append([view.camera.near for view in views])
        return evaluate(gaussians, views, *others)

    monkeypatch.setattr("clsplat.evaluate.evaluate", noted)
    path, out = write_transforms(tmp_path, posed), tmp_path / "run"
    run("train", path, "-o", out, "--iterations", 5, "--test-every", 4, "--max-gaussians", 500)
    run("eval", out, "-o", tmp_path / "eval")
    assert nears[0] == nears[1] and len(nears) == 2
    assert min(nears[0]) > 10 * load_scene(path, DataConfig(test_every=4)).test[0].camera.near


def test_masks_are_found_in_the_dataset_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_dataset(tmp_path / "data", 9)
    (tmp_path / "data" / "masks").mkdir()
    monkeypatch.chdir(tmp_path)
    config = TrainConfig(data=DataConfig(masks="masks"), init=InitConfig(triangulate=False))
    with pytest.raises(InputError, match=r"cannot find the mask of photo 0\.png: neither .*data/masks/0\.png"):
        prepare("data", config)


def masked(folder: Path) -> Path:
    """A dataset with masks inside, two of which are black."""
    write_dataset(folder, 9)
    (folder / "masks").mkdir()
    for i in range(9):
        Image.new("L", (40, 32), 0 if i in (0, 4) else 255).save(folder / "masks" / f"{i}.png")
    return folder


def test_photos_with_black_masks_are_left_out(tmp_path: Path) -> None:
    """Metrics and the search for the size have no meaning for them."""
    config = TrainConfig(data=DataConfig(masks="masks"), init=InitConfig(triangulate=False))
    with pytest.warns(UserWarning, match=r"2 of 9 photos are left out, .* black \(4.png, 0.png\)"):
        scene, _ = prepare(masked(tmp_path / "data"), config)
    assert [view.name for view in scene.test] == ["8.png"]
    assert [view.name for view in scene.train] == [f"{i}.png" for i in (1, 2, 3, 5, 6, 7)]
    for file in (tmp_path / "data" / "masks").iterdir():
        Image.new("L", (40, 32)).save(file)
    with (
        pytest.warns(UserWarning, match="9 of 9 photos"),
        pytest.raises(InputError, match="expected masks with white pixels, found black ones of all"),
    ):
        prepare(tmp_path / "data", config)


@pytest.mark.filterwarnings("ignore:.*their masks are black")
def test_a_run_continues_where_dataset_and_masks_have_moved(tmp_path: Path) -> None:
    options = ("-o", tmp_path / "run", "--iterations", 3, "--masks", "masks", "--init.random-points", 50)
    run("train", masked(tmp_path / "data"), *options)
    moved = (tmp_path / "data").rename(tmp_path / "moved")
    run("train", moved, *options, "--resume")
    run("eval", tmp_path / "run", moved)
    elsewhere = (moved / "masks").rename(tmp_path / "elsewhere")
    again = (*options[:-3], elsewhere, *options[-2:])
    run("train", moved, *again, "--resume")
    run("render", tmp_path / "run", moved)
    assert (tmp_path / "run" / "render" / "8.png").is_file()


def test_a_start_that_does_not_fit_is_refused(tmp_path: Path) -> None:
    write_dataset(tmp_path, 9)
    config = TrainConfig(memory_limit="1MB", init=InitConfig(triangulate=False))
    with pytest.raises(InputError, match=r"--memory-limit: expected at least .* for 10000 Gaussians at 40x32"):
        prepare(tmp_path, config)


def test_devices_are_opened_once() -> None:
    config = TrainConfig()
    assert open_device(config) is open_device(replace(config, iterations=5))
    limited = replace(config, memory_limit="64MB")
    assert open_device(limited) is open_device(limited) is not open_device(config)
    assert open_device(limited).memory_limit == 64 * 10**6
    with pytest.raises(InputError, match="--memory-limit: expected"):
        open_device(replace(config, memory_limit="64"))


def test_training_without_a_device_takes_that_of_the_configuration(tmp_path: Path) -> None:
    write_dataset(tmp_path / "data", 9)
    config = TrainConfig(iterations=3, memory_limit="64MB", init=InitConfig(triangulate=False, random_points=50))
    scene, config = prepare(tmp_path / "data", config)
    device = open_device(config)
    before = device.memory_peak
    assert np.isfinite(train(scene, config, tmp_path / "out").means).all()
    assert device.memory_peak > before
