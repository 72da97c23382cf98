"""Stage median, and the surfaces made of it: against the twin, and on planes whose depths and normals are known."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.camera import Camera, pixel_rays
from clsplat.config import RenderConfig
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.render import render
from clsplat.renderer import Renderer
from clsplat.testing import synthetic_scene

VIEW = np.linalg.inv(np.array([[1.0, 0, 0, 0.1], [0, 0.96, -0.28, 0.2], [0, 0.28, 0.96, -0.3], [0, 0, 0, 1]]))
CAMERAS = {
    "pinhole": Camera(VIEW, 30, 33, 20, 15, 40, 30),
    "orthographic": Camera(VIEW, 9, 10, 20, 15, 40, 30, "orthographic"),
    "fisheye": Camera(VIEW, 25, 25, 20, 15, 40, 30, "fisheye", (0.05, -0.01, 0.0, 0.0)),
    "equirectangular": Camera.panorama(VIEW, 40),
}


def plane(slope=0.3, behind=False):
    """Opaque flat Gaussians on the plane z = 3 + slope x, whose normal is (slope, 0, -1), and others farther off."""
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-4, 4, 41), np.linspace(-4, 4, 41)))
    means = np.stack([x, y, 3 + slope * x], axis=1)
    half = 0.5 * np.arctan(-slope)  # turns e_z to the normal
    n, count = 1 + behind, len(means)
    means = np.concatenate([means, means + np.array([0, 0, 2])])[: n * count]
    quats = np.tile([np.cos(half), 0, np.sin(half), 0], (n * count, 1))
    scales = np.tile(np.log([0.2, 0.2, 1e-3]), (n * count, 1))
    return Gaussians(means, scales, quats, np.full(n * count, 3.0), np.full((n * count, 1, 3), 0.5))


@pytest.mark.parametrize("projection", ["affine", "ray"])
def test_ids_match_the_twin(any_device, projection):
    gaussians, camera = synthetic_scene(200, 1, width=48, height=32, margin=1e-3)
    gaussians.logit_opacities[:] += 0.5
    config = RenderConfig(projection=projection)
    runs = [Renderer(where, config) for where in (any_device, "reference")]
    found, expected = (_ids(renderer, gaussians, camera) for renderer in runs)
    assert 0.2 < (expected >= 0).mean() < 0.98
    # In float32 a product close to 1/2 may fall on the other side.
    allowed = 0 if any_device.real == np.float64 else 0.005
    assert (found != expected).mean() <= allowed


def _ids(renderer, gaussians, camera):
    run = renderer.forward(gaussians, camera, 0)
    ids = renderer.stages.median_splats(run.splats, run.bins)
    return ids if isinstance(ids, np.ndarray) else ids.get()


def test_the_id_is_where_half_of_the_light_is_stopped(device64):
    gaussians, camera = synthetic_scene(60, 1, width=32, height=24)
    gaussians.logit_opacities[:] += 1
    renderer = Renderer(device64)
    ids = _ids(renderer, gaussians, camera)
    order = np.argsort((gaussians.means @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3])[:, 2], kind="stable")
    for y, x in [(12, 16), (5, 9), (20, 25)]:
        transmittances = [
            1 - render(gaussians.take(order[: k + 1]), camera, device=device64).alpha[y, x] for k in range(60)
        ]
        below = np.flatnonzero(np.array(transmittances) <= 0.5)
        assert ids[y, x] == (order[below[0]] if len(below) else -1)


@pytest.mark.parametrize("model", CAMERAS)
def test_depths_and_normals_of_a_plane(device, model):
    camera, config = CAMERAS[model], RenderConfig(projection="ray")
    surface = render(plane(), camera, config, device).surface()
    seen = surface.ids >= 0
    assert seen.sum() > 100
    rays, origin = pixel_rays(camera) @ camera.viewmat[:3, :3], camera.position
    normal = np.array([0.3, 0, -1]) / np.hypot(0.3, 1)
    starts = np.broadcast_to(origin, rays.shape)
    if model == "orthographic":
        v, u = np.mgrid[: camera.height, : camera.width] + 0.5
        across = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 0 * u], axis=-1)
        starts = origin + across @ camera.viewmat[:3, :3]
    distances = (([0, 0, 3] - starts) @ normal) / (rays @ normal)
    expected = distances * (pixel_rays(camera)[..., 2] if model in ("pinhole", "orthographic") else 1)
    # The flat Gaussians are a two-hundredth as thick as wide.
    np.testing.assert_allclose(surface.depth[seen], expected[seen], rtol=2e-3)
    np.testing.assert_allclose(surface.normals[seen], np.broadcast_to(normal, (seen.sum(), 3)), atol=1e-6)
    assert not surface.depth[~seen].any() and not surface.normals[~seen].any()


def test_the_median_does_not_mix_surfaces(device):
    camera = CAMERAS["pinhole"]
    both, near = plane(0, behind=True), plane(0)
    near.logit_opacities[near.means[:, 0] > 0] = -9  # half a plane, with the other one behind
    both.logit_opacities[: len(near)] = near.logit_opacities
    rendering = render(both, camera, device=device, depth=True)
    surface = rendering.surface()
    z = surface.depth
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    local = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=-1)
    world = (local - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3]
    off = np.minimum(abs(world[..., 2] - 3), abs(world[..., 2] - 5))[z > 0]
    assert len(off) > 500 and (off < 0.02).all()
    mixed = rendering.depth - z
    assert (abs(mixed[z > 0]) > 0.3).any()  # which is what the expected depth does


def test_no_surface_lies_behind_the_camera(device):
    """The affine projection draws a steep disc in pixels whose rays meet its plane behind the camera."""
    camera = Camera(np.eye(4), 64, 64, 32, 32, 64, 64)
    shape = [[0.3, 0, 0.5]], np.log([[0.6, 0.6, 0.01]]), [[0.8, 0, 0.6, 0]], [6.0], [[[0.0] * 3]]
    disc = Gaussians(*map(np.array, shape))
    rendering = render(disc, camera, device=device)
    surface = rendering.surface()
    behind = (rendering.alpha >= 0.5) & (surface.ids == -1)
    assert behind.sum() > 500 and (surface.ids == 0).sum() > 500
    assert (surface.depth[surface.ids == 0] > 0).all()
    assert not surface.depth[behind].any() and not surface.normals[behind].any()


def test_empty_scenes_and_panoramas(device):
    camera = CAMERAS["equirectangular"]
    empty = plane().take(np.zeros(0, int))
    surface = render(empty, CAMERAS["pinhole"], device=device).surface()
    assert (surface.ids == -1).all() and surface.normals.shape == (30, 40, 3)
    for where, options in ((camera, {}), (CAMERAS["pinhole"], {"gradients": False})):
        with pytest.raises(InputError, match="gradients"):
            render(plane(), where, device=device, **options).surface()


def test_nothing_visible_has_no_surface(any_device):
    gaussians, camera = synthetic_scene(5, seed=1)
    gaussians.logit_opacities[:] = -20
    assert (_ids(Renderer(any_device), gaussians, camera) == -1).all()
    faint = replace(gaussians, logit_opacities=np.full(5, -1.5))  # below 1/2 even together where two overlap
    assert (_ids(Renderer(any_device), faint.take(np.arange(2)), camera) == -1).all()
