"""Equirectangular panoramas: split into faces of a cube for training, and assembled from faces in rendering."""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from clsplat.bench.stability.projection import shell
from clsplat.bench.stability.small import CONFIG
from clsplat.camera import Camera
from clsplat.config import DataConfig, RenderConfig
from clsplat.constants import BLUR
from clsplat.dataset import load_scene
from clsplat.dataset.lenses import Intrinsics, project
from clsplat.dataset.near_planes import with_near_planes
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.metrics import to_uint8
from clsplat.panorama import FACES, assemble, face_size, faces
from clsplat.render import render
from clsplat.scene import Scene, View
from clsplat.training.initialize import initialize
from clsplat.training.loop import train


def pose(seed):
    rng = np.random.default_rng(seed)
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    viewmat = np.eye(4)
    viewmat[:3, :3] = q * np.sign(np.linalg.det(q))
    viewmat[:3, 3] = rng.normal(size=3)
    return viewmat


def sky(directions):
    """Colour of world directions (..., 3), without a seam; changes by up to 240 levels per radian."""
    x, y, z = np.moveaxis(directions, -1, 0)
    return 127.5 + 60 * np.stack([np.sin(4 * x) + y, np.cos(4 * y) - z, np.sin(4 * z) + x], axis=-1)


def pixel_directions(camera):
    """Compute the world directions of all pixels, (H, W, 3)."""
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    return camera.rays(u, v) @ camera.viewmat[:3, :3]


def write_dataset(root, count, masks=False):
    """Write a dataset with panoramas of 256 x 128 px of one sky, each with its own pose."""
    frames = []
    for k in range(count):
        camera = Camera.panorama(pose(k), 256)
        Image.fromarray(np.rint(sky(pixel_directions(camera))).astype(np.uint8)).save(root / f"{k}.png")
        to_world = np.linalg.inv(camera.viewmat)
        to_world[:, 1:3] *= -1  # axes of OpenGL
        frames.append({"file_path": f"{k}.png", "transform_matrix": to_world.tolist()})
        if masks:
            Image.fromarray((pixel_directions(camera)[..., 0] > 0).astype(np.uint8) * 255).save(root / f"m{k}.png")
            frames[-1]["mask_path"] = f"m{k}.png"
    (root / "transforms.json").write_text(json.dumps({"camera_model": "EQUIRECTANGULAR", "frames": frames}))


def test_faces_of_a_cube_are_rotations():
    for face, rotation in FACES.items():
        np.testing.assert_array_equal(rotation @ rotation.T, np.eye(3), err_msg=face)
        assert np.linalg.det(rotation) == 1, face
    assert {tuple(rotation[2]) for rotation in FACES.values()} == {tuple(s * e) for e in np.eye(3) for s in (1, -1)}


def test_rays_are_colmaps():
    """Directions of pixels on all sides are projected as by COLMAP."""
    camera = Camera.panorama(np.eye(4), 64)
    u, v = np.meshgrid(np.arange(64) + 0.5, np.arange(32) + 0.5)
    pixels = project(Intrinsics("EQUIRECTANGULAR", (64.0, 32.0), 64, 32), 3 * camera.rays(u, v).reshape(-1, 3))
    np.testing.assert_allclose(pixels.reshape(32, 64, 2), np.stack([u, v], axis=-1), atol=1e-9)


@pytest.mark.parametrize("downscale", [1, 2])
def test_a_panorama_becomes_six_pinhole_views(tmp_path, downscale):
    write_dataset(tmp_path, 1)
    scene = load_scene(tmp_path, DataConfig(test_every=0, downscale=downscale))
    assert [view.name for view in scene.train] == sorted(f"0_{face}.png" for face in FACES)
    for view in scene.train:
        camera = view.camera
        # 256 px for 2 pi: 81.5 px for a face
        assert (camera.model, camera.width, camera.height) == ("pinhole", *[81 if downscale == 1 else 41] * 2)
        assert camera.fx == camera.cx == camera.width / 2
        np.testing.assert_allclose(camera.position, Camera.panorama(pose(0), 256).position, atol=1e-9)
        # Two roundings, and bilinear interpolation with second derivatives of 960 per radian^2 in steps of 1/41.
        error = np.abs(view.image - sky(pixel_directions(camera)))
        assert error.max() < 1.5 + 2 * 960 / 8 / 41**2 * (1 if downscale == 1 else 4), view.name


@pytest.mark.parametrize("model", ["colmap", "transforms"])
def test_faces_have_at_most_as_many_pixels_as_a_screen(tmp_path, monkeypatch, model):
    """A panorama, 256 x 128 px, has faces of 81.5 x 81.5 px."""
    write_dataset(tmp_path, 1)
    if model == "colmap":
        (tmp_path / "transforms.json").unlink()
        (tmp_path / "cameras.txt").write_text("1 EQUIRECTANGULAR 256 128 256 128\n")
        (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 0.png\n\n")
        (tmp_path / "points3D.txt").write_text("")
    for screen, expected in ((81.5**2, 1), (81.4**2, 2)):
        monkeypatch.setattr("clsplat.dataset.finding.SCREEN", screen)
        assert load_scene(tmp_path, DataConfig(test_every=0)).downscale == expected


def test_masks_become_faces_too(tmp_path):
    """One of them is black, and left out without a warning."""
    write_dataset(tmp_path, 1, masks=True)
    faces = load_scene(tmp_path, DataConfig(test_every=0)).train
    assert len(faces) == 5
    for view in faces:
        x = pixel_directions(view.camera)[..., 0]
        clear = np.abs(x) > 0.03
        np.testing.assert_array_equal(view.mask[clear], (x > 0)[clear])


@pytest.mark.parametrize("panoramas", ["faces", "whole"])
def test_a_panorama_that_is_not_twice_as_wide_as_high_is_refused(tmp_path, panoramas):
    write_dataset(tmp_path, 2)
    for path in tmp_path.glob("*.png"):
        with Image.open(path) as image:
            image.crop((0, 0, 256, 120)).save(path)
    with pytest.raises(InputError, match=r"\.png: expected a panorama twice as wide as high.*found 256x120 pixels"):
        load_scene(tmp_path, DataConfig(panoramas=panoramas))


def test_faces_of_a_panorama_are_held_out_together(tmp_path):
    write_dataset(tmp_path, 3)
    scene = load_scene(tmp_path, DataConfig(test_every=2))
    assert [view.name[0] for view in scene.test] == ["0"] * 6 + ["2"] * 6
    assert [view.name[0] for view in scene.train] == ["1"] * 6


def test_a_panorama_is_assembled_from_its_faces():
    camera = Camera.panorama(pose(5), 200)
    whole = assemble(camera, [sky(pixel_directions(face)) for face in faces(camera)])
    error = np.abs(whole - sky(pixel_directions(camera)))
    assert error.max() < 2 * 960 / 8 / (face_size(camera) / 2) ** 2


DIRECTIONS = {
    "front": (0.1, 0.1, 1),
    "seam": (0, 0.2, -1),
    "edge": (1, 0.3, 1),
    "corner": (-1, -1, 1),
    "down": (0.02, 1, 0.1),
}


@pytest.mark.parametrize("projection", ["affine", "ray"])
@pytest.mark.parametrize("where", DIRECTIONS)
def test_gaussians_appear_where_they_are(device, where, projection):
    """Centre of mass and distance of one Gaussian, also at the seam and at edges of faces."""
    camera = Camera.panorama(pose(1), 240)
    direction = np.array(DIRECTIONS[where]) / np.linalg.norm(DIRECTIONS[where])
    mean = camera.position + camera.viewmat[:3, :3].T @ direction * 5
    one = Gaussians(mean[None], np.full((1, 3), np.log(0.25)), np.eye(1, 4), np.full(1, 3.0), np.full((1, 1, 3), 1.5))
    rendering = render(one, camera, RenderConfig(projection=projection), device, depth=True)
    assert rendering.rgb.shape == (120, 240, 3)
    directions = pixel_directions(camera) @ camera.viewmat[:3, :3].T
    area = np.cos((np.arange(120) + 0.5 - 60) / camera.fy)[:, None]
    centre = (directions * (rendering.alpha * area)[..., None]).sum(axis=(0, 1))
    assert np.degrees(np.arccos(direction @ centre / np.linalg.norm(centre))) < 0.3  # a fifth of a pixel
    seen = rendering.alpha > 0.5
    # Within a face a splat has a single depth z. Distances within it vary by 0.1 rad times the tangent of its angle
    # to the axis of the face; at an edge each face shows the nearer half.
    assert np.average(rendering.depth[seen], weights=rendering.alpha[seen]) == pytest.approx(5, rel=0.05)
    # The integral of alpha over the sphere is 2 pi sigma^2 times the opacity in excess of ALPHA_MIN. In a corner each
    # face shows the half that the affine approximation enlarges: by 18 % here, by 5 % at half the size. Along rays,
    # the rest is alpha's dependence on the angle to second order, and the pixels.
    solid_angle = (rendering.alpha * area).sum() / camera.fx / camera.fy
    expected = 2 * np.pi * (0.05**2 + BLUR / camera.fx**2) * 0.949
    assert solid_angle == pytest.approx(expected, rel=0.2 if projection == "affine" else 0.02)


def test_panoramas_have_no_gradients_and_may_be_empty():
    camera = Camera.panorama(pose(1), 40)
    one = Gaussians(np.ones((1, 3)), np.zeros((1, 3)), np.eye(1, 4), np.zeros(1), np.zeros((1, 1, 3)))
    rendering = render(one, camera, device="reference")
    with pytest.raises(InputError, match="not equirectangular"):
        rendering.backward(np.ones_like(rendering.rgb))
    empty = render(one.take(np.zeros(0, int)), camera, background=(0.2, 0.4, 0.6), device="reference")
    np.testing.assert_array_equal(empty.rgb, np.broadcast_to([0.2, 0.4, 0.6], (20, 40, 3)))


def test_whole_panoramas_are_trained_on_along_rays(tmp_path, device):
    write_dataset(tmp_path, 4, masks=True)
    scene = load_scene(tmp_path, DataConfig(test_every=0, downscale=2, panoramas="whole"))
    assert [view.name for view in scene.train] == [f"{k}.png" for k in range(4)]
    for k, view in enumerate(scene.train):
        camera = Camera.panorama(pose(k), 128)
        assert view.camera.model == "equirectangular" and (view.camera.width, view.camera.height) == (128, 64)
        np.testing.assert_allclose([view.camera.fx, view.camera.fy], [camera.fx, camera.fy])
        # The sky is smooth: the mean over a pixel is the value at its centre, but for the rounding.
        np.testing.assert_allclose(view.image, sky(pixel_directions(camera)), atol=3)
        assert view.mask is not None and 0.3 < view.mask.mean() < 0.7

    truth, around = shell(60).astype(np.float32), [Camera.panorama(pose(k), 96) for k in range(3)]
    truth.means[:] += around[0].position
    photos = [
        View(f"{k}", camera, to_uint8(render(truth, camera, RenderConfig(projection="ray"), device).rgb))
        for k, camera in enumerate(around)
    ]
    start = truth.means + np.random.default_rng(0).normal(scale=0.1, size=truth.means.shape)
    config = replace(CONFIG, iterations=120, max_gaussians=60, render=RenderConfig(projection="ray"))
    scene = with_near_planes(Scene(photos, [], start, np.full((60, 3), 128, np.uint8)))
    trained = train(scene, config, tmp_path / "out", device)

    def error(gaussians):
        images = [render(gaussians, view.camera, config.render, device).rgb for view in scene.train]
        return np.mean([((image - view.image / 255) ** 2).mean() for image, view in zip(images, photos, strict=True)])

    assert error(trained) < 0.4 * error(initialize(scene, config.init, config.seed))
    with pytest.raises(InputError, match="projection ray"):
        train(scene, replace(config, render=RenderConfig()), tmp_path / "affine", device)
