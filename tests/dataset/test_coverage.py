"""The pixels of held-out photos that few training photos show."""

from dataclasses import replace

import numpy as np
from walls import HEIGHT, WALL, WIDTH, scene_of, view, wall

from clsplat.camera import Camera
from clsplat.dataset.coverage import projected, rare_pixels


def test_pixels_that_two_photos_show_are_rare():
    # At the wall a photo is 5.6 wide; each of these shows the part of the held-out one right of its left border.
    train = [view(str(i), x=x) for i, x in enumerate((0.0, 0.8, 1.6, 3.2))]
    (mask,) = rare_pixels(scene_of(train, [view("t")]), wall())
    assert mask.shape == (HEIGHT, WIDTH)
    border = 1.6 * 50 / WALL
    assert mask[:, : int(border)].all() and not mask[:, int(border) + 1 :].any()
    scene = scene_of(train[:2], [view("t")])
    assert rare_pixels(scene, wall())[0].all(), "two photos are fewer than three"


def test_points_behind_the_wall_do_not_count():
    behind = 3 * wall()
    train = [view(str(i), x=x) for i, x in enumerate((0.0, 0.8, 1.6))]
    scene = scene_of(train, [view("t")])
    expected = rare_pixels(scene, wall())[0]
    assert (rare_pixels(scene, np.concatenate([wall(), behind]))[0] == expected).all()
    assert (rare_pixels(scene, behind)[0] != expected).any()


def test_a_photo_that_looks_away_does_not_count():
    away = view("a")
    turned = np.diag([-1.0, 1.0, -1.0, 1.0])
    turned[:3, 3] = away.camera.viewmat[:3, 3]
    away = replace(away, camera=replace(away.camera, viewmat=turned))
    near = [view("0"), view("1")]
    assert rare_pixels(scene_of([*near, away], [view("t")]), wall())[0].all()
    assert not rare_pixels(scene_of([*near, view("2")], [view("t")]), wall())[0].any()


def test_large_photos_are_compared_by_blocks():
    sizes = {"width": 200, "height": 101}
    train = [replace(v, camera=v.camera.resized(**sizes)) for v in (view("0", x=1.0), view("1", x=1.0))]
    test = replace(view("t"), camera=view("t").camera.resized(**sizes))
    scene = scene_of([*train, test], [test])
    (mask,) = rare_pixels(scene, wall())
    assert mask.shape == (101, 200)
    border = 1.0 * test.camera.fx / WALL
    assert abs(mask.sum(axis=1) - border).max() <= 1.5, "a block has 3 pixels"


def test_a_fisheye_has_no_rare_pixels_outside_its_circle():
    fisheye = replace(view("f"), camera=replace(view("f").camera, model="fisheye", fx=18.0, fy=18.0))
    shell = np.random.default_rng(0).normal(size=(4000, 3))
    shell *= 3 / np.linalg.norm(shell, axis=1, keepdims=True)
    scene = scene_of([replace(fisheye, name=n) for n in "abc"], [fisheye])
    assert not rare_pixels(scene, shell)[0].any()
    turned = replace(fisheye, camera=replace(fisheye.camera, viewmat=np.diag([-1.0, 1.0, -1.0, 1.0])))
    (mask,) = rare_pixels(scene_of([turned] * 3, [fisheye]), shell)
    assert mask[HEIGHT // 2, WIDTH // 2], "only what lies ahead"
    assert np.isfinite(fisheye.camera.rays(0.5, 0.5)).all() or not mask[0, 0]


def test_a_panorama_also_shows_what_is_behind_it():
    """Three photos look back at a shell around the panorama; the one ahead shows too little."""
    panorama = replace(view("p"), camera=Camera.panorama(np.eye(4), 64))
    back = np.diag([-1.0, 1.0, -1.0, 1.0])
    train = [replace(v, camera=replace(v.camera, viewmat=back @ v.camera.viewmat)) for v in (
        view("0", x=-0.5), view("1"), view("2", x=0.5))]  # fmt: skip
    u, v = np.meshgrid(np.arange(64) + 0.5, np.arange(32) + 0.5)
    on_shell = 3 * panorama.camera.rays(u, v).reshape(-1, 3)
    common = np.all([projected(other.camera, on_shell)[2] for other in train], axis=0).reshape(32, 64)
    assert common.any() and not common[:, 16:48].any(), "the middle of a panorama is ahead"
    shell = np.random.default_rng(0).normal(size=(4000, 3))
    shell *= 3 / np.linalg.norm(shell, axis=1, keepdims=True)
    (mask,) = rare_pixels(scene_of([*train, view("ahead")], [panorama]), shell)
    np.testing.assert_array_equal(mask, ~common)


def test_unknown_without_points():
    scene = scene_of([view("0")], [view("t"), view("u", z=100.0)])
    assert rare_pixels(scene, np.zeros((0, 3))) is None
    assert rare_pixels(scene, wall()) is None, "the second photo shows none"
