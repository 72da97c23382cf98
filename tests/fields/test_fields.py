"""Radiance fields: a ball and a room are learned; rays, pixels and spaces by hand."""

import json
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from ball_photos import EDGE, ball
from small_fields import CONFIG, EACH, WHITE, SmallIngp, SmallMipNerf360, SmallNerf, SmallPlenoxels

from clsplat.camera import Camera
from clsplat.dataset.near_planes import NEAR_SHARE
from clsplat.errors import InputError
from clsplat.fields import plenoxels
from clsplat.fields.field_training import train_field
from clsplat.fields.pixels import Pixels
from clsplat.fields.space import FAR, Space
from clsplat.metrics import psnr, to_uint8
from clsplat.randomness import stream
from clsplat.scene import Scene, View

pytestmark = pytest.mark.usefixtures("long_steps")


def quality(field, views):
    return float(np.mean([psnr(to_uint8(field.image(v.camera, WHITE)), v.image) for v in views]))


@EACH
def test_a_ball_is_learned(device, scene, method, tmp_path):
    """Held-out photos: far better than the background alone, which has 8 dB."""
    field = train_field(scene, method, CONFIG, tmp_path, device)
    assert quality(field, scene.test) > 20
    losses = [json.loads(line)["loss"] for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert losses[-1] < 0.1 * losses[0]


def test_the_spheres_learn_a_room(device, tmp_path, monkeypatch):
    """Plenoxels: the ball in the middle, and a wall outside of the grid. A contracted grid had 14 dB."""
    monkeypatch.setattr(SmallPlenoxels, "cells", 16)
    room = ball(room=True)
    field = train_field(room, SmallPlenoxels, CONFIG, tmp_path, device)
    assert quality(field, room.test) > 15


@pytest.mark.parametrize("method", [SmallNerf, SmallMipNerf360], ids=lambda m: m.name)
def test_a_room_is_learned(device, method, tmp_path):
    """Contracted space: the ball in the middle and a wall three times as far as the cameras, in held-out photos.

    Their mean colour alone has 11 dB.
    """
    room = ball(room=True)
    field = train_field(room, method, CONFIG, tmp_path, device)
    assert field.space.contracted
    assert quality(field, room.test) > 17


def test_rays_without_samples_see_the_background(device, scene, monkeypatch):
    """Plenoxels with one transparent cell in a corner, rendered row by row: most rows have no sample."""
    monkeypatch.setattr("clsplat.fields.field.RENDERED_RAYS", 24)
    field = SmallPlenoxels(Space.of(scene.train), device, 0)
    occupied = np.zeros((8, 8, 8), np.uint8)
    occupied[0, 0, 0] = 1
    field._grid.place(occupied, np.zeros((8, 28)))
    image = field.image(scene.test[0].camera, WHITE)
    np.testing.assert_array_equal(image, np.ones_like(image))


@EACH
def test_a_fisheye_within_the_cube_shows_the_background_in_its_corners(device, scene, method):
    """Pixels that see nothing have no rays: one without a direction would have samples without end."""
    field = method(Space.of(scene.train), device, 0)
    centre, scale = field.space.centre, field.space.scale
    camera = Camera.look_at(centre + scale * np.array([0.2, 0.1, 0]), centre, (0, 0, 1), 3.0, 16, 16)
    camera = replace(camera, model="fisheye")
    v, u = np.divmod(np.arange(256), 16)
    blind = np.isnan(camera.rays(u + 0.5, v + 0.5)).any(axis=1).reshape(16, 16)
    image = field.image(camera, (0.25, 0.5, 1.0))
    assert 0 < blind.sum() < 50 and np.isfinite(image).all()
    np.testing.assert_array_equal(image[blind], np.tile([0.25, 0.5, 1.0], (blind.sum(), 1)))
    assert (image[~blind] != image[blind][0]).any(axis=1).all()


def test_an_orthographic_camera_is_refused(device, scene):
    """All its rays would begin in one point, and the image have a single colour."""
    field = SmallNerf(Space.of(scene.train), device, 0)
    with pytest.raises(InputError, match="expected a perspective one for a field, found an orthographic one"):
        field.image(replace(scene.test[0].camera, model="orthographic"), WHITE)


def test_cells_are_refined_while_pixels_are_smaller(device, scene):
    """A pixel of these photos is 1/40 of the cube wide in its middle: 16 cells are allowed, 32 are not."""
    field = SmallPlenoxels(Space.of(scene.train), device, 0)
    assert field._resolved()
    field._grid.place(np.ones((16, 16, 16), np.uint8), np.zeros((17**3, 28)))
    assert not field._resolved()


def test_trainings_of_any_length_smooth_as_much(device, monkeypatch):
    """Plenoxels with a background: the weights of the total variation, summed over the steps but the first."""
    room = ball(room=True)
    space = Space.of(room.train)
    assert space.contracted
    pixels = Pixels(room.train, space, WHITE)
    for steps in (4, 8):
        field, weights = SmallPlenoxels(space, device, 0), {28: [], 4: []}

        def recorded(*arguments, smooth=field.stages.voxels_tv, weights=weights):
            # Weights are divided by the number of corners in a visit.
            weights[arguments[2].shape[1]].append(np.multiply(arguments[4], arguments[6]))
            return smooth(*arguments)

        monkeypatch.setattr(field.stages, "voxels_tv", recorded)
        monkeypatch.setattr(plenoxels, "EVENTS", ())  # all steps have cells of one size
        for i in range(steps):
            field.step(pixels.draw(stream(0, "pixels of a batch", i), field.rays), i / steps)
        monkeypatch.undo()
        size = len(field._grid.occupied) / plenoxels.TV_CELLS
        expected = {
            28: (size * plenoxels.SPACE_TV_DENSITY * plenoxels.SPACE_DENSITY_SCALE / 2,
                 size * plenoxels.SPACE_TV_HARMONICS),
            4: (plenoxels.SPHERE_TV_DENSITY * plenoxels.SPHERE_DENSITY_SCALE, plenoxels.SPHERE_TV_COLOR),
        }  # fmt: skip
        for features, found in weights.items():
            np.testing.assert_allclose(np.sum(found, axis=0) * steps / (steps - 1), expected[features])


def test_the_finest_level_has_the_resolution_of_the_photos(device, scene):
    """Photos with half as many pixels along an edge have a finest level with half as many cells."""
    space = Space.of(scene.train)
    fine, coarse = (SmallIngp(replace(space, pixel=width), device, 0) for width in (space.pixel, 2 * space.pixel))
    assert fine.levels.resolutions[-1] == round(1 / (0.4 * space.pixel))
    assert abs(fine.levels.resolutions[-1] - 2 * coarse.levels.resolutions[-1]) <= 1


def test_pixels_are_those_of_the_photos(scene):
    """Colours on the drawn background; rays that lead to the pixels."""
    space = Space.of(scene.train)
    pixels = Pixels(scene.train, space, WHITE)
    batch = pixels.draw(stream(0, "pixels of a batch"), 500)
    assert batch.background != WHITE
    # A ray that misses the ball has the background's colour, and no other one.
    along = -np.einsum("rc,rc->r", batch.directions, batch.origins - 0.5)
    nearest = np.linalg.norm(batch.origins - 0.5 + along[:, None] * batch.directions, axis=1) * space.scale
    missed = nearest > 0.7
    assert 50 < missed.sum() < 450
    np.testing.assert_allclose(batch.colors[missed], np.tile(batch.background, (missed.sum(), 1)), atol=1e-9)


def test_a_channel_alpha_without_transparency_changes_nothing(scene):
    opaque = [replace(view, clear=np.zeros_like(view.clear)) for view in scene.train]
    none = [replace(view, clear=None) for view in scene.train]
    first, second = Space.of(opaque), Space.of(none)
    assert first.contracted and second.contracted and first.scale == second.scale
    batch = Pixels(opaque, first, WHITE).draw(stream(0, "pixels of a batch"), 20)
    assert batch.background == WHITE
    one = [replace(opaque[0], clear=scene.train[0].clear), *opaque[1:]]
    assert not Space.of(one).contracted and Pixels(one, Space.of(one), WHITE).transparent


def test_masked_pixels_are_not_drawn(scene):
    views = [replace(v, mask=np.zeros(v.image.shape[:2], bool)) for v in scene.train]
    views[3].mask[5, 7] = True
    batch = Pixels(views, Space.of(views), WHITE).draw(stream(0, "pixels of a batch"), 20)
    np.testing.assert_array_equal(batch.directions, np.tile(batch.directions[0], (20, 1)))


def test_photos_are_not_copied(scene):
    """What they take besides: 4 bytes for each pixel that a mask leaves."""
    views = [replace(v, mask=np.arange(EDGE**2).reshape(EDGE, EDGE) % 4 == 0) for v in scene.train]
    large = [replace(v, **{name: np.tile(getattr(v, name), (40, 1, 1)[: getattr(v, name).ndim])
                           for name in ("image", "mask", "clear")},
                     camera=replace(v.camera, height=40 * EDGE)) for v in views]  # fmt: skip
    space, bytes_used = Space.of(views), []
    for part in (large, [replace(v, mask=None) for v in large]):
        tracemalloc.start()
        pixels = Pixels(part, space, WHITE)
        bytes_used.append(tracemalloc.get_traced_memory()[0])
        tracemalloc.stop()
        assert pixels.transparent
    total = len(large) * 40 * EDGE**2
    assert bytes_used[0] < 4 * total / 4 + 20_000 and bytes_used[1] < 20_000


def test_photos_without_transparency_have_a_contracted_space(scene):
    views = [replace(v, clear=None) for v in scene.train]
    space = Space.of(views)
    assert space.contracted and space.marching.contracted and space.marching.far == FAR
    positions = [(v.camera.position - space.centre) / space.scale for v in views]
    assert np.linalg.norm(positions, axis=1).max() <= 1 + 1e-9
    background = Pixels(views, space, WHITE).draw(stream(0, "pixels of a batch"), 5).background
    assert background == WHITE


def test_rays_begin_before_the_nearest_points(scene):
    """At 0.8 of their depth, of which the near plane of the nearest photo is a share: nothing learns a haze there."""
    nears = [NEAR_SHARE * depth for depth in np.linspace(2.0, 3.0, len(scene.train))]
    cameras = [replace(v.camera, near=near) for v, near in zip(scene.train, nears, strict=True)]
    views = [replace(v, clear=None, camera=camera) for v, camera in zip(scene.train, cameras, strict=True)]
    space = Space.of(views)
    assert space.near * space.scale == pytest.approx(0.8 * 2.0)
    assert space.marching.near == space.span.near == space.near


@EACH
def test_a_tripod_has_rays(device, tmp_path, method):
    """Cameras that turn in one place, up to a thousandth of the distance of what they see."""
    views = []
    for k, off in enumerate(np.random.default_rng(0).normal(size=(12, 3)) * 1e-3):
        ahead = (np.cos(k * np.pi / 6), np.sin(k * np.pi / 6), 0)
        camera = replace(Camera.look_at(off, off + ahead, (0, 0, 1), EDGE, EDGE, EDGE), near=0.3)
        v, u = np.divmod(np.arange(EDGE**2), EDGE)
        directions = camera.rays(u + 0.5, v + 0.5) @ camera.viewmat[:3, :3]
        colors = 0.5 + 0.5 * np.sin(3 * directions + 1)
        views.append(View(f"{k}", camera, np.rint(255 * colors).astype(np.uint8).reshape(EDGE, EDGE, 3)))
    space = Space.of(views)
    assert space.near == 1 and space.scale == pytest.approx(0.8) and space.pixel == pytest.approx(1 / EDGE, rel=0.1)
    scene = Scene(views, [], np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    train_field(scene, method, replace(CONFIG, iterations=60), tmp_path, device)
    losses = [json.loads(line)["loss"] for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert losses[-1] < 0.5 * losses[0]
