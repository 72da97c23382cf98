"""Points from outlines: of a ball before a plain background, whose photos are computed by its equation."""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from clsplat.camera import Camera
from clsplat.config import DataConfig
from clsplat.dataset import load_scene_with_points
from clsplat.dataset.outlines import Grid, background, free_space, in_free_space, plain_color, points_of_outlines
from clsplat.scene import View

RADIUS, PLACE = 0.5, np.array([3.0, -2.0, 5.0])
GREY, RED = 200, np.array([180, 30, 20])
"""Colours of the background and of the ball."""


def photo(position, size=(80, 60), radius=RADIUS, noise=0):
    camera = Camera.look_at(PLACE + position, PLACE, (0, -1, 0), size[0], *size)
    x, y = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    rays = camera.rays(x, y) @ camera.viewmat[:3, :3]
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    away = PLACE - camera.position
    missed = np.linalg.norm(away - (rays @ away)[:, :, None] * rays, axis=2) > radius
    image = np.where(missed[:, :, None], GREY, RED) + np.random.default_rng(0).integers(
        -noise, noise + 1, (*size[::-1], 3)
    )
    return View(f"{position}.png", camera, image.astype(np.uint8))


def around(count=12, **how):
    """Photos from two rings, one level and one above."""
    angles = 2 * np.pi * np.arange(count) / count
    return [photo(2.5 * np.array([np.cos(a), -0.6 * (k % 2), np.sin(a)]), **how) for k, a in enumerate(angles)]


def test_points_lie_on_the_object() -> None:
    points, colors = points_of_outlines(around(noise=6))
    away = np.linalg.norm(points - PLACE, axis=1)
    # The hull is larger than the ball: near the axis of the rings, the outlines leave two caps. A cell has an edge of
    # some 0.013, and a pixel shows 0.03.
    assert len(points) > 10_000
    assert RADIUS - 0.06 < away.min()
    assert abs(np.median(away) - RADIUS) < 0.03 and np.quantile(away, 0.9) < RADIUS + 0.08
    assert np.abs(colors - RED).max() <= 6
    # They surround it, and lie in cells of their own.
    assert (points.min(axis=0) < PLACE - 0.45).all() and (points.max(axis=0) > PLACE + 0.45).all()


def test_points_repeat_to_the_bit() -> None:
    first, second = (points_of_outlines(around(4)) for _ in range(2))
    np.testing.assert_array_equal(first[0], second[0])
    np.testing.assert_array_equal(first[1], second[1])


def test_a_small_object_has_points_too() -> None:
    """A ball of a twentieth of the photo's width: the second grid lies around it alone."""
    points, _ = points_of_outlines(around(size=(160, 120), radius=0.06))
    away = np.linalg.norm(points - PLACE, axis=1)
    assert len(points) > 5_000 and away.max() < 0.12


def test_space_before_a_plain_background_is_free() -> None:
    views = around()
    grids = free_space(views)
    assert [len(grid.free) for grid in grids] == [80, 64, 64]
    cameras = np.array([view.camera.position for view in views])
    directions = np.random.default_rng(0).normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    ball = PLACE + RADIUS * directions
    # Half a pixel within the ball, 0.02: the pixels of this test are not mixed at the outline.
    assert not in_free_space(PLACE + 0.96 * (ball - PLACE), grids).any()
    between = PLACE + np.linspace(0.35, 0.8, 10)[:, None, None] * (cameras - PLACE)
    assert in_free_space(between.reshape(-1, 3), grids).mean() > 0.9
    # Nothing is known of what is far away.
    assert not in_free_space(PLACE + 30 * directions, grids).any()


def test_the_finest_grid_decides() -> None:
    """Of two grids around (1, 0, 0), the first of which has one free cell."""
    centre, fine = np.array([1.0, 0.0, 0.0]), np.zeros((2, 2, 2), bool)
    fine[1, 0, 1] = True
    grids = [Grid(centre, 1.0, fine), Grid(centre, 2.0, np.ones((4, 4, 4), bool))]
    places = [[1.5, -0.5, 0.5], [1.5, 0.5, 0.5], [0.5, -0.5, 0.5], [2.5, 0.0, 0.0], [3.5, 0.0, 0.0]]
    assert in_free_space(places, grids).tolist() == [True, False, False, True, False]


def test_photos_without_a_plain_background_have_no_outlines() -> None:
    rng = np.random.default_rng(1)
    views = [replace(view, image=rng.integers(0, 256, view.image.shape, np.uint8)) for view in around()]
    assert plain_color(views) is None
    for found in points_of_outlines(views):
        assert found.shape == (0, 3)
    assert free_space(views) == [] and not in_free_space(np.zeros((3, 3)), []).any()
    # An object that covers more than half of the photos' edges.
    views = around()
    for view in views:
        view.image[:, :44] = RED
    assert plain_color(views) is None


@pytest.mark.parametrize(("ground", "plain"), [(0.48, True), (0.52, False)])
@pytest.mark.parametrize("side", range(4))
def test_each_edge_shows_a_plain_background(ground: float, plain: bool, side: int) -> None:
    """Half of one edge is something else, such as the ground below a sky; of all four it is an eighth."""
    views = around()
    for view in views:
        edge = [view.image[0], view.image[-1], view.image[:, 0], view.image[:, -1]][side]
        edge[: round(ground * len(edge))] = RED
    assert (plain_color(views) is not None) == plain


def test_photos_of_the_background_alone_have_no_points() -> None:
    assert len(points_of_outlines(around(radius=0.0))[0]) == 0


def test_two_photos_are_too_few() -> None:
    assert len(points_of_outlines(around()[:2])[0]) == 0
    assert len(points_of_outlines([around()[k] for k in (0, 3, 6, 9)])[0]) > 0


def test_the_background_is_joined_to_the_edge() -> None:
    """A spot of the background's colour on the object is a part of the object."""
    view = photo(np.array([2.5, 0.0, 0.0]))
    spotted = replace(view, image=view.image.copy())
    spotted.image[28:32, 38:42] = GREY
    color = np.full(3, GREY / 255)
    found = background(spotted, color)
    np.testing.assert_array_equal(found, background(view, color))
    assert found[0].all() and not found[30, 40]
    # 0.06 of 255 is 15.3.
    for value, same in (GREY - 15, True), (GREY - 16, False):
        view.image[5, 5] = (GREY, value, GREY)
        assert background(view, color)[5, 5] == same


def test_one_photo_alone_does_not_carve() -> None:
    """In one of 12 photos the object has the background's colour; two of them are too many."""
    views = around()
    for count, found in (1, True), (2, False):
        blank = [replace(view, image=np.full_like(view.image, GREY)) for view in views[:count]]
        points, colors = points_of_outlines([*blank, *views[count:]])
        assert bool(len(points)) == found
        np.testing.assert_array_equal(colors, np.broadcast_to(RED, colors.shape))


def test_what_a_mask_hides_is_not_the_background() -> None:
    """An edge of the photos that is masked: neither the background, whose colour it has, nor in its way."""
    views = around()
    masked = []
    for view in views:
        image, mask = view.image.copy(), np.ones(view.image.shape[:2], bool)
        mask[:, :10] = False
        masked.append(replace(view, image=image, mask=mask))
    np.testing.assert_allclose(plain_color(masked), GREY / 255)
    assert not background(masked[0], np.full(3, GREY / 255))[:, :10].any()
    nothing = [replace(view, mask=np.zeros_like(view.mask)) for view in masked]
    assert plain_color(nothing) is None


def test_a_dataset_of_poses_without_features_gets_points_from_outlines(tmp_path) -> None:
    frames = []
    for k, view in enumerate(around(6)):
        Image.fromarray(view.image).save(tmp_path / f"{k}.png")
        pose = np.linalg.inv(view.camera.viewmat) @ np.diag([1, -1, -1, 1])
        frames.append({"file_path": f"{k}.png", "transform_matrix": pose.tolist()})
    lens = {"fl_x": 80, "fl_y": 80, "cx": 40, "cy": 30, "w": 80, "h": 60}
    (tmp_path / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    scene = load_scene_with_points(tmp_path, DataConfig(test_every=0))
    assert len(scene.points) > 5_000 and len(scene.colors) == len(scene.points)
    # Near planes are three tenths of the depth of the nearest points, which are 2 or more away.
    assert all(0.5 < view.camera.near < 0.3 * 2.9 for view in scene.train)
