"""Meshes: of a ball made of flat Gaussians, and of the still life, against their known surfaces."""

from dataclasses import replace

import numpy as np
import pytest
from plyfile import PlyData

from clsplat.camera import Camera
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.meshing import TRUNCATION, Mesh, _zeros, make_mesh, save_mesh
from clsplat.renderer import Renderer


def ball(n=1500):
    """Flat Gaussians on the unit sphere: red where x > 0, green elsewhere."""
    k = np.arange(n) + 0.5
    z, turn = 1 - 2 * k / n, np.pi * (1 + 5**0.5) * k
    normals = np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], axis=1)
    # The quaternion that turns e_z to the normal.
    quats = np.stack([1 + z, -normals[:, 1], normals[:, 0], np.zeros(n)], axis=1)
    scales = np.tile(np.log([0.06, 0.06, 1e-3]), (n, 1))
    colors = np.where(normals[:, :1] > 0, [[1.0, 0, 0]], [[0, 1.0, 0]])
    sh = ((colors - 0.5) / 0.28209479177387814)[:, None]
    return Gaussians(normals, scales, quats, np.full(n, 4.0), sh).astype(np.float32)


def around(count=12, size=64):
    turns = 2 * np.pi * np.arange(count) / count
    eyes = [[3 * np.cos(a), 3 * np.sin(a), 2.5 * (-1) ** k] for k, a in enumerate(turns)]
    return [Camera.look_at(eye, [0, 0, 0], [0, 0, 1], size, size, size) for eye in eyes]


@pytest.mark.parametrize("resolution", [32, 48])
def test_the_mesh_of_a_ball_is_a_sphere(device, tmp_path, resolution):
    mesh = make_mesh(ball(), around(), Renderer(device), resolution=resolution)
    voxel = 2.2 / resolution
    radii = np.linalg.norm(mesh.vertices, axis=1)
    assert abs(radii - 1).mean() < 0.3 * voxel and abs(radii - 1).max() < 2 * voxel
    corners = mesh.vertices[mesh.faces]
    areas = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    assert areas.sum() == pytest.approx(4 * np.pi, rel=0.1)
    # Triangles turn their front to the outside.
    outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) * corners.mean(axis=1)
    assert (outward.sum(axis=1) > 0).mean() > 0.99
    clear = abs(mesh.vertices[:, 0]) > 0.2
    red = mesh.vertices[clear, 0] > 0
    assert (mesh.colors[clear, 0] > 128).astype(int).tolist() == red.astype(int).tolist()

    save_mesh(tmp_path / "ball.ply", mesh)
    ply = PlyData.read(tmp_path / "ball.ply")
    np.testing.assert_allclose(np.stack([ply["vertex"][k] for k in "xyz"], axis=1), mesh.vertices, atol=1e-6)
    np.testing.assert_array_equal(ply["vertex"]["red"], mesh.colors[:, 0])
    np.testing.assert_array_equal(np.stack(ply["face"]["vertex_indices"]), mesh.faces)


def test_the_size_of_the_world_does_not_matter(device):
    """The near plane of cameras without one follows the Gaussians. A fixed one would hide this scene."""
    small = replace(ball(), means=1e-3 * ball().means, log_scales=ball().log_scales + np.float32(np.log(1e-3)))
    cameras = [replace(c, viewmat=np.vstack([c.viewmat[:3] * [1, 1, 1, 1e-3], c.viewmat[3:]])) for c in around()]
    box = np.full(3, -1.2), np.full(3, 1.2)
    large = make_mesh(ball(), around(), Renderer(device), resolution=32, box=box)
    mesh = make_mesh(small, cameras, Renderer(device), resolution=32, box=(1e-3 * box[0], 1e-3 * box[1]))
    assert len(mesh.vertices) == pytest.approx(len(large.vertices), rel=0.01)
    assert abs(np.linalg.norm(mesh.vertices, axis=1) - 1e-3).max() < 2e-4


def test_a_box_cuts_the_mesh(device):
    mesh = make_mesh(ball(), around(), Renderer(device), resolution=32, box=([0, -1.2, -1.2], [1.2, 1.2, 1.2]))
    assert mesh.vertices[:, 0].min() > -0.01 and mesh.vertices[:, 1].min() < -0.9


def test_meshes_need_pinholes_and_surfaces(device):
    renderer, cameras = Renderer(device), around(2)
    with pytest.raises(InputError, match="pinhole cameras"):
        make_mesh(ball(), [replace(cameras[0], model="orthographic")], renderer)
    faint = ball()
    faint.logit_opacities[:] = -6
    with pytest.raises(InputError, match="half of the light"):
        make_mesh(faint, cameras, renderer)
    with pytest.raises(InputError, match="found none"):
        make_mesh(ball(), cameras, renderer, resolution=16, box=([5, 5, 5], [6, 6, 6]))
    for high in ([5, 5, 5], [6, 4, 6]):
        with pytest.raises(InputError, match="positive size"):
            make_mesh(ball(), cameras, renderer, resolution=16, box=([5, 5, 5], high))


def test_views_past_the_surface_do_not_darken_it(device):
    """They show that space is free, and have no colour for it."""
    cameras, past = around(), [Camera.look_at([3, 0, z], [0, 0, z], [0, 0, 1], 64, 64, 64) for z in (1.9, -1.9)]
    colors = [
        make_mesh(ball(), views, Renderer(device), resolution=32).colors.max(axis=1).astype(float)
        for views in (cameras, cameras + 4 * past)
    ]
    assert colors[1].mean() == pytest.approx(colors[0].mean(), rel=0.02)


def test_pixels_whose_surface_has_no_depth_free_nothing(device):
    """A disc before the camera fills the image. In pixels over the ball, its largest density is behind the camera."""
    viewmat = np.eye(4)
    viewmat[:3, 3] = [-1.5, 0, 4]
    blocked = Camera(viewmat, 64, 64, 32, 32, 64, 64, near=1e-3)
    disc = ball(1)
    disc.means[:], disc.quats[:] = [1.515, 0, -3.975], [0.8, 0, 0.6, 0]
    disc.log_scales[:], disc.logit_opacities[:] = np.log([0.03, 0.03, 5e-4]), 6
    scene, box = Gaussians.concatenate([ball(), disc]), ([-1.2] * 3, [1.2] * 3)
    views = around()
    alone, mesh = (make_mesh(scene, v, Renderer(device), resolution=24, box=box) for v in (views, [*views, blocked]))
    np.testing.assert_array_equal(mesh.vertices, alone.vertices)


def test_voxels_without_a_colour_do_not_darken_the_surface():
    """Where most views look past a thin surface, the voxels in front of it have no colour."""
    distances, colors = np.full((12, 12, 12), TRUNCATION, np.float32), np.zeros((12, 12, 12, 3), np.float32)
    distances[6:], colors[6:] = -1, [200, 100, 50]
    mesh = _zeros(distances, colors, distances < 0, np.zeros(3), 1.0)
    assert len(mesh.vertices) and (mesh.colors == [200, 100, 50]).all()


def test_voxels_of_both_signs_that_do_not_touch():
    distances = np.full((12, 12, 12), np.nan, np.float32)
    distances[:5], distances[7:] = 1, -1
    with pytest.raises(InputError, match="expected surfaces in the box, found none"):
        _zeros(distances, np.zeros((12, 12, 12, 3), np.float32), distances < 0, np.zeros(3), 1.0)


def test_a_mesh_far_from_the_origin_keeps_its_shape(tmp_path):
    vertices = np.array([[0.01, 5.4e6, 0], [0.11, 5.4e6 + 0.3, 0], [0.31, 5.4e6 + 0.7, 1]])
    save_mesh(tmp_path / "far.ply", Mesh(vertices, np.array([[0, 1, 2]]), np.zeros((3, 3), np.uint8)))
    ply = PlyData.read(tmp_path / "far.ply")["vertex"]
    np.testing.assert_array_equal(np.stack([ply[name] for name in "xyz"], axis=1), vertices)


def test_the_sky_does_not_enlarge_the_box(device):
    sky = replace(ball(400), log_scales=np.full((400, 3), np.log(10), np.float32))
    sky = replace(sky, means=100 * sky.means)
    alone = make_mesh(ball(), around(), Renderer(device), resolution=32)
    mesh = make_mesh(Gaussians.concatenate([ball(), sky]), around(), Renderer(device), resolution=32)
    assert abs(mesh.vertices).max() == pytest.approx(abs(alone.vertices).max(), rel=0.05)
