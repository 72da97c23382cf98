"""Brightness of photos: jumps are told from slow changes, and are removed before a training."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.dataset.brightness import CLIPPED, FEWEST_PHOTOS, LEAST, divided, evened, gains, jumps
from clsplat.dataset.coverage import projected
from clsplat.scene import Scene, View

PHOTOS = 16
COUNT = 300


def path(count: int = PHOTOS) -> NDArray[np.float64]:
    """Positions along a bend, not evenly spaced."""
    along = np.linspace(0, 1, count) + 0.2 / count * np.sin(np.arange(count))
    return np.stack([4 * np.cos(along), 4 * np.sin(along), np.zeros(count)], axis=1)


def alternating(count: int = PHOTOS, size: float = 0.1) -> NDArray[np.float64]:
    """Jumps of both signs without a pattern."""
    signs = np.random.default_rng(1).normal(size=count)
    return size * signs


def scene_of(factors: NDArray[np.float64]) -> Scene:
    """Photos of points as squares of one colour, each photo times its factor, and which photo shows which point."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.7, 0.7, (COUNT, 3))
    colors = rng.uniform(40, 160, (COUNT, 3))
    views, shown = [], {}
    for k, (place, factor) in enumerate(zip(path(len(factors)), factors, strict=True)):
        camera = Camera.look_at(place, [0, 0, 0], [0, 0, 1], 600, 480, 360)
        places, depths, inside = projected(camera, points)
        image = np.full((360, 480, 3), 100.0) * factor
        for row in np.argsort(-depths):
            column, line = places[row].astype(int)
            image[max(0, line - 3) : line + 4, max(0, column - 3) : column + 4] = colors[row] * factor
        # Like features: those in front hide others.
        near = (np.abs(places[:, None] - places) < 7).all(axis=2)
        hidden = (near & (depths < depths[:, None])).any(axis=1)
        views.append(View(f"{k:02}.png", camera, np.rint(np.clip(image, 0, 255)).astype(np.uint8)))
        shown[f"{k:02}.png"] = np.flatnonzero(inside & ~hidden)
    return Scene(views, [], points, np.rint(colors).astype(np.uint8), shown=shown)


def logs(scene: Scene) -> NDArray[np.float64]:
    found = gains(scene)
    return np.log([found.get(view.name, np.ones(3)) for view in scene.train])


@pytest.mark.parametrize("count", [10, PHOTOS, 40])
def test_slow_changes_are_no_jumps(count: int) -> None:
    slow = 0.2 * np.sin(2 * path(count)[:, 1])[:, None] + np.zeros(3)
    assert np.abs(jumps(slow, path(count))).max() < LEAST


@pytest.mark.parametrize(("count", "least"), [(PHOTOS, 0.8), (40, 0.9)])
def test_jumps_are_found_over_slow_changes(count: int, least: float) -> None:
    """With fewer photos, more of the jumps looks like a slow change."""
    slow, jump = 0.2 * np.sin(2 * path(count)[:, 1]), alternating(count)
    found = jumps((slow + jump)[:, None] + np.zeros(3), path(count))
    assert np.corrcoef(found[:, 0], jump)[0, 1] > least
    left = slow + jump - found[:, 0]
    assert np.diff(left).std() < np.diff(slow + jump).std() / 2, "what is left must be smoother"


def test_channels_have_jumps_of_their_own() -> None:
    tints = 0.1 * np.random.default_rng(2).normal(size=(40, 3))
    found = jumps(tints, path(40))
    for channel in range(3):
        assert np.corrcoef(found[:, channel], tints[:, channel])[0, 1] > 0.9


def test_photos_from_one_place_have_no_jumps() -> None:
    """The faces of panoramas show different things, and share no points."""
    places = np.repeat(path(4), 4, axis=0)
    np.testing.assert_array_equal(jumps(alternating(16)[:, None] + np.zeros(3), places), 0)


def test_gains_are_those_of_the_photos() -> None:
    jump = alternating()
    found = logs(scene_of(np.exp(jump)))
    np.testing.assert_allclose(found[:, 0] - found[:, 0].mean(), jump - jump.mean(), atol=2 * LEAST)


def test_photos_that_hardly_differ_have_no_gains() -> None:
    assert gains(scene_of(np.ones(PHOTOS))) == {}
    assert gains(scene_of(np.exp(alternating(size=LEAST / 2)))) == {}
    assert len(gains(scene_of(np.exp(alternating(size=2 * LEAST))))) == PHOTOS


def changed(
    scene: Scene, index: int, columns: slice, image: NDArray[np.uint8] | float, masked: bool = False
) -> Scene:
    """The scene with other pixels in some columns of a photo, behind a mask or not."""
    view = scene.train[index]
    pixels, mask = view.image.copy(), np.ones(view.image.shape[:2], bool)
    pixels[:, columns] = np.clip(pixels[:, columns] * image, 0, 255) if np.isscalar(image) else image
    mask[:, columns] = not masked
    other = replace(view, image=pixels, mask=mask if masked else None)
    return replace(scene, train=[*scene.train[:index], other, *scene.train[index + 1 :]])


def test_what_masks_hide_does_not_count() -> None:
    """A part of a photo is brighter, behind a mask."""
    jump = alternating()
    found = logs(changed(scene_of(np.exp(jump)), 5, slice(0, 220), 1.4, masked=True))
    np.testing.assert_allclose(found[:, 0] - found[:, 0].mean(), jump - jump.mean(), atol=2 * LEAST)


def test_photos_that_are_hidden_or_clipped_have_no_factor() -> None:
    scene = scene_of(np.exp(alternating()))
    everywhere = slice(0, 480)
    for hidden in (0, 3, PHOTOS - 1):
        scene = changed(scene, hidden, everywhere, 1.0, masked=True)
    scene = changed(changed(scene, 6, everywhere, np.full(3, 255, np.uint8)), 9, everywhere, 0.05)
    unknown = {view.name for view in scene.train} - gains(scene).keys()
    assert unknown == {"00.png", "03.png", "06.png", "09.png", "15.png"}


def test_hidden_points_do_not_count() -> None:
    """A third of a photo shows something bright before its points."""
    jump = alternating()
    found = logs(changed(scene_of(np.exp(jump)), 5, slice(0, 160), np.full(3, 230, np.uint8)))
    np.testing.assert_allclose(found[:, 0] - found[:, 0].mean(), jump - jump.mean(), atol=2 * LEAST)


def test_points_of_one_photo_tell_nothing() -> None:
    scene = scene_of(np.exp(alternating()))
    rng = np.random.default_rng(4)
    alone = np.concatenate([scene.points, rng.uniform(-0.7, 0.7, (16 * 400, 3))])
    own = COUNT + np.arange(16 * 400).reshape(16, 400)
    rows = {name: np.concatenate([r, k]) for (name, r), k in zip(scene.shown.items(), own, strict=True)}
    np.testing.assert_allclose(logs(replace(scene, points=alone, shown=rows)), logs(scene), atol=1e-9)


def test_clipped_colors_do_not_count() -> None:
    """Half of the points are nearly white, and clipped in brighter photos."""
    jump = alternating()
    found = logs(scene_of(1.5 * np.exp(jump)))
    np.testing.assert_allclose(found[:, 0] - found[:, 0].mean(), jump - jump.mean(), atol=2 * LEAST)


@pytest.mark.parametrize("factor", [0.01, 10.0])
def test_jumps_have_no_scale_and_no_mean(factor: float) -> None:
    """What is slow is told by its shape alone."""
    values = (0.2 * np.sin(2 * path()[:, 1]) + alternating())[:, None] + np.zeros(3)
    expected = factor * jumps(values, path())
    np.testing.assert_allclose(jumps(factor * values + 3, path()), expected, atol=1e-6 * factor)


def test_without_tracks_or_with_few_photos_there_are_no_gains() -> None:
    scene = scene_of(np.exp(alternating()))
    assert gains(scene) and gains(replace(scene, shown={})) == {}
    assert gains(replace(scene, train=scene.train[: FEWEST_PHOTOS - 1])) == {}
    assert gains(replace(scene, shown={name: rows[:50] for name, rows in scene.shown.items()})) == {}


def test_colors_are_divided_except_where_they_are_clipped() -> None:
    values = np.arange(256, dtype=np.uint8).reshape(16, 16)
    view = View("a.png", Camera.look_at([0, 0, 3], [0, 0, 0], [0, 1, 0], 20, 16, 16), np.stack([values] * 3, axis=2))
    darker = divided(view, [2.0, 1.0, 0.5]).image.reshape(256, 3)
    np.testing.assert_array_equal(darker[:CLIPPED, 0], np.rint(np.arange(CLIPPED) / 2))
    np.testing.assert_array_equal(darker[CLIPPED:, 0], np.arange(CLIPPED, 256))
    np.testing.assert_array_equal(darker[:, 1], np.arange(256))
    np.testing.assert_array_equal(darker[:, 2], np.minimum(2 * np.arange(256), 255))


def test_a_scene_is_evened_once() -> None:
    """Photos that do not differ stay the same objects, and held-out photos as they are."""
    scene = scene_of(np.ones(PHOTOS))
    scene = replace(scene, train=scene.train[1:], test=scene.train[:1], gains={"03.png": np.full(3, 2.0)})
    found = evened(scene)
    assert [a is b for a, b in zip(found.train, scene.train, strict=True)].count(False) == 1
    np.testing.assert_array_equal(found.train[2].image, np.rint(scene.train[2].image / 2))
    assert found.test == scene.test and not found.gains
