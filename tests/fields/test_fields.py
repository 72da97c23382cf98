"""Radiance fields: a ball is learned, runs repeat and resume to the bit, and files hold what renders."""

import json
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from ball_photos import EDGE, ball
from small_fields import SmallIngp, SmallMipNerf360, SmallNerf, SmallPlenoxels

from clsplat.camera import Camera
from clsplat.config import BACKGROUNDS, DataConfig, TrainConfig
from clsplat.dataset.near_planes import NEAR_SHARE
from clsplat.errors import InputError
from clsplat.fields import METHODS, plenoxels
from clsplat.fields.field_files import MODEL, load_checkpoint, load_field, save_checkpoint, save_field
from clsplat.fields.field_training import train_field
from clsplat.fields.pixels import Pixels
from clsplat.fields.space import FAR, Space
from clsplat.inputs import Inputs
from clsplat.metrics import psnr, to_uint8
from clsplat.randomness import stream
from clsplat.resuming import CHECKPOINT, FREE
from clsplat.scene import Scene, View

WHITE = BACKGROUNDS["white"]
CONFIG = TrainConfig(iterations=250, data=DataConfig(background="white"))


SMALL = [SmallIngp, SmallPlenoxels, SmallNerf, SmallMipNerf360]
EACH = pytest.mark.parametrize("method", SMALL, ids=lambda m: m.name)

CASES = [*((method, False) for method in SMALL), (SmallPlenoxels, True)]
ALL = pytest.mark.parametrize(("method", "room"), CASES, ids=lambda v: v.name if isinstance(v, type) else f"room={v}")
"""All methods without a background, and the one with it whose model then has other arrays."""


@pytest.fixture(autouse=True)
def long_steps(monkeypatch):
    """An eighth of the samples on a ray: the photos are small, too."""
    monkeypatch.setattr("clsplat.fields.space.STEP", 3**0.5 / 128)


@pytest.fixture(scope="module")
def scene():
    return ball()


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


@ALL
def test_runs_repeat_and_resume_to_the_bit(device, method, room, tmp_path):
    config, scene = replace(CONFIG, iterations=40), ball(room=room)
    folders = [tmp_path / name for name in ("whole", "again", "interrupted")]
    for folder in folders:
        folder.mkdir()
    whole, again = (train_field(scene, method, config, folder, device) for folder in folders[:2])

    def interrupt(record):
        if record["iteration"] == 23:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_field(scene, method, config, folders[2], device, progress=interrupt)
    resumed = train_field(scene, method, config, folders[2], device, resume=True)
    for other in (again, resumed):
        for name, array in whole.model().items():
            np.testing.assert_array_equal(other.model()[name], array)
    logs = [(folder / "log.jsonl").read_text().splitlines() for folder in folders[1:]]
    lines = [[json.loads(line) | {"seconds": None} for line in log] for log in logs]
    assert [line["iteration"] for line in lines[0]] == [10, 20, 30, 40] and lines[1] == lines[0]


@EACH
def test_an_interrupt_within_a_step_leaves_the_last_checkpoint(device, scene, method, tmp_path, monkeypatch):
    """Half of a step is no state from which a run could go on to the same bits."""
    config = replace(CONFIG, iterations=12, checkpoint_every=5)
    (tmp_path / "whole").mkdir()
    whole = train_field(scene, method, config, tmp_path / "whole", device)

    def interrupted(*_):
        raise KeyboardInterrupt

    def evaluate(field):
        if field.iteration == 6:
            field.stages.rays_bwd = interrupted
        return {}

    with pytest.raises(KeyboardInterrupt):
        train_field(scene, method, config, tmp_path, device, evaluate=evaluate)
    inputs = Inputs.of(scene, device)
    assert load_checkpoint(tmp_path / CHECKPOINT, method, config, inputs, device)[0].iteration == 5
    resumed = train_field(scene, method, config, tmp_path, device, resume=True)
    for name, array in whole.model().items():
        np.testing.assert_array_equal(resumed.model()[name], array)


@ALL
def test_the_file_renders_what_was_trained(device, method, room, tmp_path):
    scene = ball(room=room)
    field = train_field(scene, method, replace(CONFIG, iterations=20), tmp_path, device)
    loaded = load_field(tmp_path / MODEL, {method.name: method}, device)
    camera = scene.test[0].camera
    np.testing.assert_array_equal(loaded.image(camera, WHITE), field.image(camera, WHITE))


@EACH
def test_another_configuration_does_not_resume(device, scene, method, tmp_path):
    config = replace(CONFIG, iterations=2)
    train_field(scene, method, config, tmp_path, device)
    inputs = Inputs.of(scene, device)
    with pytest.raises(InputError, match="expected the configuration it was made with"):
        load_checkpoint(tmp_path / CHECKPOINT, method, replace(config, seed=1), inputs, device)
    free = {"device": "a", "checkpoint_every": 7, "eval_every": 8, "memory_limit": "9GB"}
    assert free.keys() == set(FREE)
    assert load_checkpoint(tmp_path / CHECKPOINT, method, replace(config, **free), inputs, device)[0].iteration == 2


def test_other_photos_do_not_resume(device, scene, tmp_path):
    config = replace(CONFIG, iterations=2)
    train_field(scene, SmallNerf, config, tmp_path, device)
    first, *others = scene.train
    negative = replace(scene, train=[replace(first, image=255 - first.image), *others])
    with pytest.raises(InputError, match=rf"expected the dataset it was made with, found other pixels.*{first.name}"):
        train_field(negative, SmallNerf, config, tmp_path, device, resume=True)
    with pytest.raises(InputError, match="found fewer photos"):
        train_field(replace(scene, train=others), SmallNerf, config, tmp_path, device, resume=True)


def test_masks_may_move(device, scene, tmp_path):
    config = replace(CONFIG, iterations=2, data=DataConfig(masks="/a/masks"))
    train_field(scene, SmallNerf, config, tmp_path, device)
    moved = replace(config, data=DataConfig(masks="/b/masks"))
    train_field(scene, SmallNerf, moved, tmp_path, device, resume=True)
    hidden = [replace(view, mask=np.eye(EDGE, dtype=bool)) for view in scene.train]
    with pytest.raises(InputError, match="found other masks"):
        train_field(replace(scene, train=hidden), SmallNerf, moved, tmp_path, device, resume=True)


def test_another_device_resumes_with_a_warning(device, scene, tmp_path):
    config = replace(CONFIG, iterations=2)
    train_field(scene, SmallNerf, config, tmp_path, device)
    elsewhere = replace(Inputs.of(scene, device), device="another")
    with pytest.warns(UserWarning, match="the run continues on another"):
        load_checkpoint(tmp_path / CHECKPOINT, SmallNerf, config, elsewhere, device)


@pytest.mark.parametrize(("name", "value"), [("inputs", {}), ("inputs", 3), ("seconds", "x"), ("losses", [None])])
def test_damaged_facts_of_a_checkpoint_are_refused(device, scene, tmp_path, name, value):
    path, config = tmp_path / CHECKPOINT, replace(CONFIG, iterations=2)
    train_field(scene, SmallNerf, config, tmp_path, device)
    arrays = dict(np.load(path))
    about = json.loads(str(arrays["about"])) | {name: value}
    np.savez(path, **arrays | {"about": np.array(json.dumps(about))})
    with pytest.raises(InputError, match=f"{CHECKPOINT}: expected a checkpoint of clsplat, found a damaged file"):
        load_checkpoint(path, SmallNerf, config, Inputs.of(scene, device), device)


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


def test_damaged_files_are_refused(device, tmp_path):
    path = tmp_path / MODEL
    with pytest.raises(InputError, match="found no file"):
        load_field(path, METHODS, device)
    path.write_bytes(b"PK\x03\x04 no archive")
    with pytest.raises(InputError, match="damaged"):
        load_field(path, METHODS, device)
    np.savez(path, about=json.dumps({"method": "nerd"}))
    with pytest.raises(InputError, match="expected a field of nerf, nerf-small, plenoxels"):
        load_field(path, METHODS, device)


@pytest.mark.parametrize("byte", [8, 10], ids=["encrypted", "compression"])
def test_archives_that_python_cannot_read_are_damaged(byte, device, scene, tmp_path):
    """Bits of the flags, and the method, in the first entry of the archive's directory."""
    path = tmp_path / MODEL
    save_field(path, SmallNerf(Space.of(scene.train), device, 0))
    archive = bytearray(path.read_bytes())
    archive[archive.index(b"PK\x01\x02") + byte] |= 0x41
    path.write_bytes(archive)
    with pytest.raises(InputError, match="damaged"):
        load_field(path, {SmallNerf.name: SmallNerf}, device)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("table", lambda a: a[:-1]),
        ("table", lambda a: a[:, :4]),
        ("cells", lambda a: np.array([512, 1, 1])),
        ("squares", lambda a: a[:-1]),
    ],
)
def test_a_grid_whose_arrays_do_not_fit_is_refused(device, scene, tmp_path, name, change):
    """Kernels would read beyond the end of the arrays."""
    path, config = tmp_path / CHECKPOINT, replace(CONFIG, iterations=1)
    inputs = Inputs.of(scene, device)
    save_checkpoint(path, SmallPlenoxels(Space.of(scene.train), device, 0), config, inputs, 0.0, [])
    arrays = dict(np.load(path))
    np.savez(path, **arrays | {name: change(arrays[name])})
    with pytest.raises(InputError, match="damaged"):
        load_checkpoint(path, SmallPlenoxels, config, inputs, device)


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
