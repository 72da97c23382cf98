"""Gaussians of the sky: where photos show it, where they lie, and what they are for."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.config import DataConfig, InitConfig, TrainConfig
from clsplat.device import Device
from clsplat.gaussians import Gaussians
from clsplat.scene import Scene, View
from clsplat.stages import Dropout
from clsplat.training.initialize import initialize
from clsplat.training.loop import train
from clsplat.training.sky_start import (
    DISTANCE,
    OPACITY,
    SIZE,
    SPACING,
    UNSEEN,
    beyond,
    sky_cells,
    sky_gaussians,
    sphere,
    vertical,
    with_sky,
)

UP = np.array([0.0, -1.0, 0.0])
BLUE = np.array([90, 140, 220])
WIDTH, HEIGHT = 80, 60
CONFIG = TrainConfig()


def camera(position=(0.0, 0.0, 0.0), target=(0.0, 0.0, 1.0), up=(0, -1, 0)):
    return Camera.look_at(position, target, up, 50, WIDTH, HEIGHT)


def outdoors(seen, seed=0):
    """A photo with noise below the horizon of a level camera, and the sky above it."""
    image = np.random.default_rng(seed).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    image[: HEIGHT // 2] = BLUE
    return View(f"{seed}.png", seen, image)


def points_below(count=1500):
    rng = np.random.default_rng(3)
    return np.column_stack([rng.uniform(-8, 8, count), np.ones(count), rng.uniform(-8, 8, count)])


def square(views):
    points = points_below()
    return Scene(views, [], points, np.zeros(points.shape, np.uint8))


def ring(count=8):
    angles = 2 * np.pi * np.arange(count) / count
    spots = np.stack([np.cos(angles), np.zeros(count), np.sin(angles)], axis=1)
    return [outdoors(camera(spot, 2 * spot), k) for k, spot in enumerate(spots)]


def test_the_sphere_is_even() -> None:
    directions = sphere(2000)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, rtol=1e-12)
    nearest = np.sort(np.linalg.norm(directions[:, None] - directions[None], axis=2), axis=1)[:, 1]
    # A square lattice with as many points has a distance of (4 pi / 2000)^(1/2).
    assert 0.8 < nearest.min() / np.sqrt(4 * np.pi / 2000) < nearest.max() / np.sqrt(4 * np.pi / 2000) < 1.1


@pytest.mark.parametrize("height", [-0.7, 0.0, 0.7], ids=["from above", "level", "from below"])
def test_the_vertical_of_cameras_on_a_ring(height) -> None:
    angles = np.linspace(0, 4, 7)
    cameras = [camera((np.cos(a), height, np.sin(a)), (0, 0, 0)) for a in angles]
    # The mean of their up vectors has a weight of 0.01, and is 0.25 from the vertical.
    np.testing.assert_allclose(vertical(cameras), UP, atol=0.01)


def test_the_vertical_of_cameras_with_one_direction_is_theirs() -> None:
    cameras = [camera((x, 0, 0), (x, 0.5, 2)) for x in (0.0, 1.0, 2.0)]
    np.testing.assert_allclose(vertical(cameras), -cameras[0].viewmat[1, :3], atol=1e-12)


def test_a_drone_that_turns_has_no_horizon() -> None:
    ups = [(np.cos(a), 0, np.sin(a)) for a in np.arange(4) * np.pi / 2]
    assert vertical([camera((0, -5, 0), (0, 0, 0), up) for up in ups]) is None
    scene = square([outdoors(camera((0, -5, 0), (0, 0, 0), up), k) for k, up in enumerate(ups)])
    assert sky_gaussians(scene, CONFIG) is None


def cells_of(view, points=None):
    cells, averages, edge = sky_cells(view, np.zeros((0, 3)) if points is None else points, UP)
    assert edge == 4  # the least, as photos of 80 x 60 have a diagonal of 100
    return cells, averages


def test_cells_of_the_sky_are_smooth_and_reach_the_edge() -> None:
    view = outdoors(camera())
    view.image[:] = np.random.default_rng(1).integers(0, 256, view.image.shape)
    view.image[:20] = BLUE
    view.image[24:28, 20:40] = BLUE  # smooth, and enclosed by texture
    cells, averages = cells_of(view)
    assert cells[:5].all() and not cells[5:].any()
    np.testing.assert_allclose(averages[:5], np.broadcast_to(BLUE / 255, (5, 20, 3)))


@pytest.mark.parametrize(("channels", "factor"), [(slice(None), 1), (2, 3)], ids=["grey", "blue"])
@pytest.mark.parametrize(("deviation", "smooth"), [(0.047, True), (0.053, False)])
@pytest.mark.parametrize("size", [1, 3], ids=["cells of 4 px", "of 6 px"])
def test_cells_of_the_sky_have_little_texture(channels, factor, deviation, smooth, size) -> None:
    """A chequerboard deviates from its mean by as much in each pixel; blue is a third of the grey value."""
    view = outdoors(Camera.look_at((0, 0, 0), (0, 0, 1), UP, 50 * size, WIDTH * size, HEIGHT * size))
    view = replace(view, image=np.full((HEIGHT * size, WIDTH * size, 3), 128, np.uint8))
    signs = np.where(np.indices(view.image.shape[:2]).sum(axis=0) % 2, 1, -1)[:, :, None]
    board = np.rint(128 + signs * 255 * deviation * factor)
    view.image[:, :, channels] = board if factor == 1 else board[:, :, 0]
    cells, _, edge = sky_cells(view, np.zeros((0, 3)), UP)
    assert edge == {1: 4, 3: 6}[size]
    assert cells[0].all() == cells.any() == smooth


def test_what_is_smooth_below_the_horizon_is_no_sky() -> None:
    view = outdoors(camera())
    view.image[:] = BLUE
    cells, _ = cells_of(view)
    # Row 8 has the slope (34 - 30) / 50 downwards, more than the sky may reach below the horizon.
    assert cells[:8].all() and not cells[8:].any()


def test_what_is_smooth_at_the_horizon_only_is_no_sky() -> None:
    view = outdoors(camera())
    view.image[:28] = view.image[32:].copy()
    view.image[28:32] = BLUE
    assert not cells_of(view)[0].any()


def test_cells_with_points_or_masked_pixels_or_a_background_are_no_sky() -> None:
    view = outdoors(camera())
    point = np.array([[0.0, -0.4, 1.0]])  # in the pixel (40, 10)
    cells, _ = cells_of(view, point)
    assert not cells[2, 10] and cells[:7].sum() == 7 * 20 - 1
    mask = np.ones((HEIGHT, WIDTH), bool)
    mask[9, 41] = False
    assert not cells_of(replace(view, mask=mask))[0][2, 10]
    clear = np.zeros((HEIGHT, WIDTH), np.uint8)
    clear[9, 41] = 1
    assert not cells_of(replace(view, clear=clear))[0][2, 10]


def test_last_cells_of_an_odd_size_are_whole() -> None:
    view = outdoors(Camera.look_at((0, 0, 0), (0, 0, 1), (0, -1, 0), 50, 79, 58))
    view = replace(view, image=np.ascontiguousarray(view.image[:58, :79]))
    cells, _ = cells_of(view)
    assert cells.shape == (15, 20) and cells[:7].all()


def test_the_sky_of_a_square_is_above_and_blue() -> None:
    scene = square(ring())
    sky = sky_gaussians(scene, CONFIG)
    assert sky is not None and sky.means.dtype == np.float32
    directions = sky.means / np.linalg.norm(sky.means, axis=1, keepdims=True)
    heights = directions @ UP
    # The photos reach to the slope 30 / 50, and the sky as far beyond them as it may.
    highest = np.sin(np.arctan(0.6) + UNSEEN)
    assert -0.05 < heights.min() < 0.05 and highest - 0.05 < heights.max() < highest
    assert len(sky) == pytest.approx(2 * np.pi / SPACING**2 * (heights.max() - heights.min()), rel=0.02)
    np.testing.assert_allclose(np.linalg.norm(sky.means, axis=1), DISTANCE * scene.extent, rtol=1e-5)
    np.testing.assert_allclose(0.5 + 0.28209479 * sky.sh[:, 0], np.broadcast_to(BLUE / 255, (len(sky), 3)), atol=1e-6)
    assert not sky.sh[:, 1:].any()
    np.testing.assert_allclose(sky.opacities, OPACITY, rtol=1e-5)
    np.testing.assert_allclose(np.exp(sky.log_scales), SIZE * SPACING * DISTANCE * scene.extent, rtol=1e-5)
    again = sky_gaussians(scene, CONFIG)
    assert all(np.array_equal(a, b) for a, b in zip(sky.arrays().values(), again.arrays().values(), strict=True))


def test_the_sky_is_behind_all_points() -> None:
    scene = square(ring())
    scene = replace(scene, points=np.concatenate([scene.points, np.full((40, 3), [0.0, 900.0, 0.0])]))
    sky = sky_gaussians(scene, CONFIG)
    np.testing.assert_allclose(np.linalg.norm(sky.means, axis=1), 2700, rtol=1e-5)


def test_no_sky_where_one_photo_shows_something_else() -> None:
    views = ring()
    wall = replace(views[0], name="wall.png", image=np.random.default_rng(9).integers(0, 256, (60, 80, 3), np.uint8))
    clear, blocked = sky_gaussians(square(views), CONFIG), sky_gaussians(square([*views, wall]), CONFIG)
    ahead = np.array([1.0, -0.2, 0.0]) / np.sqrt(1.04)
    for sky, some in (clear, True), (blocked, False):
        directions = sky.means / np.linalg.norm(sky.means, axis=1, keepdims=True)
        assert bool((directions @ ahead > np.cos(0.1)).any()) == some


def test_the_sky_continues_a_little_where_no_photo_looks() -> None:
    view = ring()[0]
    sky = sky_gaussians(square([view, replace(view, name="2.png")]), CONFIG)
    directions = sky.means / np.linalg.norm(sky.means, axis=1, keepdims=True)
    forward = view.camera.viewmat[2, :3]
    reach = np.arctan(np.hypot(WIDTH, HEIGHT) / 2 / 50) + UNSEEN
    assert np.arccos(directions @ forward).max() < reach
    assert np.arccos(directions @ forward).max() > reach - 0.3
    beside = np.abs(directions @ view.camera.viewmat[0, :3]) > 0.8 * (directions @ forward)  # outside of the photo
    assert beside.sum() > 20 and (directions[beside] @ UP).min() > 0


def test_masks_have_no_say_in_the_sky() -> None:
    """Half of the photos are masked above the horizon; the others show the same directions as sky."""
    views = [view for view in ring() for _ in range(2)]
    expected = sky_gaussians(square(views), CONFIG)
    hidden = np.arange(HEIGHT)[:, None].repeat(WIDTH, axis=1) >= HEIGHT // 2
    found = sky_gaussians(square([replace(v, mask=hidden if k % 2 else None) for k, v in enumerate(views)]), CONFIG)
    assert expected and found
    np.testing.assert_array_equal(found.means, expected.means)
    np.testing.assert_allclose(found.sh, expected.sh, atol=1e-6)
    assert sky_gaussians(square([replace(view, mask=hidden) for view in views]), CONFIG) is None


@pytest.mark.parametrize(("columns", "enough"), [(0, False), (4, False), (12, True)])
def test_with_dropout_photos_must_agree_on_the_sky(columns: int, enough: bool) -> None:
    """A second photo, from the same place, shows sky in some columns: about 0.01 steradians each."""
    view, without, dropout = ring()[0], CONFIG, replace(CONFIG, dropout=0.1)
    image = np.random.default_rng(9).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    image[: HEIGHT // 2, 20 : 20 + columns] = BLUE
    away = [outdoors(camera(target=(0.0, 0.0, -1.0)), 5)] if not columns else []  # a sky that this one alone shows
    views = [view, replace(view, name="2.png", image=image), *away]
    assert sky_gaussians(square(views), without) is not None
    assert (sky_gaussians(square(views), dropout) is not None) == enough


def test_with_dropout_a_plain_background_is_the_sky_of_one_photo() -> None:
    image = np.full((HEIGHT, WIDTH, 3), 200, np.uint8)
    image[20:40, 30:50] = np.random.default_rng(9).integers(0, 256, (20, 20, 3))
    scene = square([View("0.png", camera(), image)])
    assert sky_gaussians(scene, replace(CONFIG, dropout=0.1), plain=True) is not None


def test_the_background_needs_no_sky() -> None:
    views = ring()
    white = replace(CONFIG, data=DataConfig(background="white"))
    for view in views:
        view.image[: HEIGHT // 2] = 250  # a difference of 5 / 255 = 0.0196
    assert sky_gaussians(square(views), CONFIG) is not None
    assert sky_gaussians(square(views), white) is None
    for view in views:
        view.image[: HEIGHT // 2] = 249
    assert sky_gaussians(square(views), white) is not None


def test_a_start_without_sky_is_unchanged() -> None:
    scene = square(ring())
    first = initialize(scene, InitConfig(), 0)
    assert with_sky(first, scene, replace(CONFIG, init=InitConfig(sky=False))) is first
    assert with_sky(first, replace(scene, points=np.zeros((0, 3))), CONFIG) is first
    for view in scene.train:
        view.image[:] = np.random.default_rng(9).integers(0, 256, view.image.shape)
    assert with_sky(first, scene, CONFIG) is first


def test_the_sky_counts_among_the_most_gaussians() -> None:
    scene = square(ring())
    first = initialize(scene, InitConfig(), 0)
    whole = with_sky(first, scene, CONFIG)
    count = len(whole) - len(first)
    assert 0 < count < len(first)
    np.testing.assert_array_equal(whole.means[: len(first)], first.means)
    limited = with_sky(first, scene, replace(CONFIG, max_gaussians=2 * count))
    assert len(limited) == 2 * count
    np.testing.assert_array_equal(limited.means[count:], whole.means[-count:])
    np.testing.assert_array_equal(limited.means[[0, count - 1]], first.means[[0, -1]])
    assert with_sky(first, scene, replace(CONFIG, max_gaussians=2 * count - 1)) is first
    fewer = first.take(np.arange(count - 1))
    assert with_sky(fewer, scene, CONFIG) is fewer


def test_what_is_beyond_the_scene() -> None:
    scene = square(ring())
    means = np.array([[0, -10 * scene.extent, 0], [0, -20 * scene.extent, 0]], np.float32)
    one = initialize(scene, InitConfig(), 0, 2)
    assert beyond(replace(one, means=means), scene).tolist() == [False, True]


def test_a_training_keeps_the_sky_that_no_photo_shows(device: Device, tmp_path) -> None:
    scene = square(ring())
    config = replace(CONFIG, iterations=4, size="fixed", max_gaussians=5000)
    trained: dict[bool, Gaussians] = {}
    for sky in True, False:
        settings = replace(config, init=InitConfig(sky=sky, dense=False))
        trained[sky] = train(scene, settings, tmp_path / str(sky), device)
    found = trained[True].means[beyond(trained[True], scene)]
    assert (found @ UP / np.linalg.norm(found, axis=1)).max() > 0.8  # photos reach to 0.51
    assert not beyond(trained[False], scene).any()


def test_dropout_leaves_the_sky(device: Device, tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, used = square(ring()), []

    def noted(*fields: float) -> Dropout:
        used.append(Dropout(*fields))
        return used[-1]

    monkeypatch.setattr("clsplat.training.session.Dropout", noted)
    config = replace(CONFIG, iterations=2, size="fixed", max_gaussians=5000, dropout=0.5)
    train(scene, config, tmp_path, device)
    assert len(used) == 2
    assert all(scene.extent < dropout.far < DISTANCE * scene.extent for dropout in used)


def test_of_many_photos_some_decide(monkeypatch: pytest.MonkeyPatch) -> None:
    looked_at = []

    def noted(view: View, *others: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
        looked_at.append(view.name)
        return sky_cells(view, *others)

    monkeypatch.setattr("clsplat.training.sky_start.sky_cells", noted)
    monkeypatch.setattr("clsplat.training.sky_start.MOST_PHOTOS", 3)
    scene = square(ring(9))
    assert sky_gaussians(scene, CONFIG) is not None
    assert looked_at == [scene.train[k].name for k in (0, 4, 8)]
