"""The demo's photos against their true cameras, and the positions of the cameras."""

from functools import partial

import numpy as np
import pytest
from PIL import ExifTags, Image
from scipy.ndimage import map_coordinates

from clsplat.camera import Camera
from clsplat.demo import known_photos as demo
from clsplat.demo.ray_tracer import Solid, bake, camera_rays, radiance, trace
from clsplat.demo.shapes import Square
from clsplat.demo.still_life import still_life
from clsplat.errors import InputError


@pytest.fixture(scope="module")
def solids():
    """The still life with coarse light. The other properties of a photo do not depend on the number of rays."""
    scene = still_life()
    bake(scene, sun_rays=2, sky_rays=8)
    return scene


@pytest.fixture(scope="module")
def cameras():
    return demo.viewpoints(30, 160, 120, np.random.default_rng(0))


@pytest.fixture(scope="module")
def photos(solids, cameras):
    """Two neighbours on the low ring and one of the high ring."""
    return {k: demo.take_photo(cameras[k], solids) for k in (15, 16, 26)}


def test_a_point_has_one_colour_in_all_views(solids):
    rng = np.random.default_rng(7)
    points = np.stack([*rng.uniform(-1, 1, (2, 600)), np.full(600, 0.012)])
    eyes = (np.array([1.5, -2.0, 2.4]), np.array([-2.2, 0.4, 1.9]))
    colours, seen = [], np.full(600, True)
    for eye in eyes:
        d = points - eye[:, None]
        distance = np.linalg.norm(d, axis=0)
        seen &= np.abs(trace(eye[:, None], d / distance, solids)[0] - distance) < 1e-6
        colours.append(radiance(eye, d / distance, solids))
    assert seen.sum() > 50
    np.testing.assert_allclose(colours[0][:, seen], colours[1][:, seen], atol=1e-6)  # edges magnify rounding
    assert colours[0][:, seen].std(axis=1).min() > 0.1


def test_photos_agree_where_they_show_the_same_points(photos, cameras, solids):
    rng = np.random.default_rng(7)
    a, b = cameras[15], cameras[16]
    x, y = rng.uniform(8, 152, 2000), rng.uniform(8, 112, 2000)
    rays = camera_rays(a, x, y)
    t, _ = trace(a.position[:, None], rays, solids)
    points = a.position[:, None] + t * rays
    back = points - b.position[:, None]
    distance = np.linalg.norm(back, axis=0)
    image = b.K @ (b.viewmat[:3, :3] @ points + b.viewmat[:3, 3:])
    u, v = image[:2] / image[2]
    visible = np.abs(trace(b.position[:, None], back / distance, solids)[0] - distance) < 1e-6
    visible &= (u > 8) & (u < 152) & (v > 8) & (v < 112)
    assert visible.mean() > 0.4

    def look_up(photo, x, y):
        places = np.stack([y[visible] - 0.5, x[visible] - 0.5])
        return np.stack([map_coordinates(photo[..., c], places, order=1) for c in range(3)])

    seen_by_a, seen_by_b = look_up(photos[15], x, y), look_up(photos[16], u, v)
    same = np.abs(seen_by_a - seen_by_b)
    other = np.abs(seen_by_a - np.roll(seen_by_b, 17, axis=1))
    # At a third of the size, textures blur differently in each view: 0.011 for the same points, 0.17 for others.
    assert np.median(same) < 0.02
    assert np.median(other) > 8 * np.median(same)


@pytest.mark.parametrize("offset", [-0.2, 0.2])
@pytest.mark.parametrize("axis", [0, 1])
def test_pixels_lie_where_the_camera_projects_them(axis, offset):
    edge = 5 + offset * 2 / 10  # pixels times distance by focal length
    board = Solid(Square(), lambda p: np.full_like(p, 0.5), np.array([[0, edge, 0], [edge, 0, 0]])[axis], 5)
    camera = Camera.look_at((0, 0, 2), (0, 0, 0), (0, -1, 0), 10.0, 12, 8)
    line = np.moveaxis(demo.take_photo(camera, [board])[..., 0], axis, 0)[:, 2]
    dark, bright, half = line.min(), line.max(), len(line) // 2
    assert bright - dark > 0.3
    # The board's edge runs near the middle of the image, between two rays at a quarter of a pixel from it.
    steps = np.abs(line - line[0]) > (bright - dark) / 2
    np.testing.assert_array_equal(steps, np.arange(len(line)) >= half)
    np.testing.assert_array_equal(line[: half - 1], line[0])
    np.testing.assert_array_equal(line[half + 1 :], line[-1])


def test_photos_are_exposed_and_detailed_everywhere(photos):
    for photo in photos.values():
        assert photo.shape == (120, 160, 3)
        assert 0.3 < photo.mean() < 0.6
        assert ((photo <= 0) | (photo >= 1)).mean() < 0.01
        luma = photo @ [0.299, 0.587, 0.114]
        gradient = np.hypot(*np.gradient(luma))
        blocks = gradient.reshape(6, 20, 8, 20).mean(axis=(1, 3))
        # The sensor's noise on a flat surface yields 0.005. Matching needs a multiple of it everywhere.
        assert blocks.min() > 0.02
        assert gradient.mean() > 0.04


def test_cameras_surround_the_scene_and_look_at_it(cameras):
    positions = np.array([c.position for c in cameras])
    angles = np.sort(np.arctan2(positions[:20, 1], positions[:20, 0]))
    assert np.diff(angles, append=angles[0] + 2 * np.pi).max() < np.radians(30)
    assert positions[20:, 2].min() > positions[:20, 2].max()
    for camera in cameras:
        middle = camera.viewmat[:3, :3] @ [0, 0, 0.25] + camera.viewmat[:3, 3]
        assert np.abs(middle[:2] / middle[2]).max() < 0.1


def test_a_seed_repeats_the_photos(tmp_path, monkeypatch):
    monkeypatch.setattr(demo, "bake", partial(bake, sun_rays=1, sky_rays=4))
    made = {
        name: demo.make_photos(tmp_path / name, count=3, width=48, height=36, seed=seed)
        for name, seed in (("a", 0), ("b", 0), ("c", 1))
    }
    assert sorted(p.name for p in (tmp_path / "a").iterdir()) == ["000.jpg", "001.jpg", "002.jpg"]
    for k, name in enumerate(["000.jpg", "001.jpg", "002.jpg"]):
        first, second, other = ((tmp_path / run / name).read_bytes() for run in "abc")
        assert first == second != other
        np.testing.assert_array_equal(made["a"][k].viewmat, made["b"][k].viewmat)
    assert np.abs(made["a"][0].viewmat - made["c"][0].viewmat).max() > 1e-3

    with Image.open(tmp_path / "a" / "001.jpg") as photo:
        assert photo.size == (48, 36)
        assert [layer[1:3] for layer in photo.layer] == [(1, 1)] * 3  # no chroma subsampling
        focal = photo.getexif().get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm]
        pixels = np.asarray(photo) / 255
    solids = still_life()
    demo.bake(solids)
    # The sensor's noise and the rounding of the JPEG differ by 0.012 on average; another camera's photo by 0.22.
    assert np.abs(demo.take_photo(made["a"][1], solids) - pixels).mean() < 0.02
    assert made["a"][1].fx == pytest.approx(focal * np.hypot(48, 36) / np.hypot(36, 24))


@pytest.mark.parametrize("bad", [{"count": 0}, {"width": 0}, {"height": -1}, {"seed": -1}])
def test_impossible_photos_are_refused(tmp_path, bad):
    with pytest.raises(InputError, match=next(iter(bad))):
        demo.make_photos(tmp_path / "photos", **bad)
    assert not (tmp_path / "photos").exists()


@pytest.mark.slow
def test_poses_are_recovered_from_the_photos_alone(tmp_path):
    import pycolmap

    from clsplat.config import SfmConfig
    from clsplat.dataset.sfm.reconstruction import reconstruct

    cameras = demo.make_photos(tmp_path / "images")
    model = pycolmap.Reconstruction(reconstruct(tmp_path, SfmConfig()))
    assert model.num_reg_images() == len(cameras)
    assert model.compute_mean_reprojection_error() < 0.5  # px; measured: 0.3
    poses = {int(image.name[:3]): image.cam_from_world().matrix() for image in model.images.values()}
    found = np.array([-poses[k][:, :3].T @ poses[k][:, 3] for k in range(len(cameras))])
    true = np.array([camera.position for camera in cameras])
    found, true = found - found.mean(0), true - true.mean(0)
    # Similarity alignment: Umeyama 1991, doi:10.1109/34.88573.
    u, s, vt = np.linalg.svd(true.T @ found)
    sign = np.array([1, 1, np.linalg.det(u @ vt)])
    rotation = u * sign @ vt
    found = (s @ sign) / (found**2).sum() * found @ rotation.T
    radius = np.linalg.norm(true, axis=1).mean()
    assert np.linalg.norm(found - true, axis=1).max() < 0.005 * radius  # measured: 0.0012
    for k, camera in enumerate(cameras):
        turn = poses[k][:, :3] @ rotation.T @ camera.viewmat[:3, :3].T
        assert np.degrees(np.arccos((np.trace(turn) - 1) / 2)) < 0.2  # measured: 0.06


def test_the_known_scene_has_true_cameras_and_points():
    scene = demo.known_scene(9, 64, 48, points=300)
    assert [v.name for v in scene.test] == ["000.png", "008.png"] and len(scene.train) == 7
    assert 200 < len(scene.points) <= 300 and scene.colors.shape == scene.points.shape
    # Each point comes from one photo: of those that contain it, one has exactly its colour there.
    matched = np.zeros(len(scene.points), bool)
    for view in scene.train:
        p = scene.points @ view.camera.viewmat[:3, :3].T + view.camera.viewmat[:3, 3]
        x, y = (p[:, :2] / p[:, 2:] * [view.camera.fx, view.camera.fy] + [view.camera.cx, view.camera.cy]).T
        inside = (p[:, 2] > 0) & (x >= 0) & (x < 64) & (y >= 0) & (y < 48)
        rows = np.flatnonzero(inside)
        matched[rows] |= (view.image[y[rows].astype(int), x[rows].astype(int)] == scene.colors[rows]).all(axis=1)
    # By rounding, a ray at a pixel's edge may fall into the neighbouring pixel.
    assert matched.mean() > 0.99
    again = demo.known_scene(9, 64, 48, points=300)
    assert (again.points == scene.points).all() and (again.train[3].image == scene.train[3].image).all()


def test_a_known_scene_without_training_photos_is_refused():
    with pytest.raises(InputError, match="expected at least 2, 1, 1 and 1, found 1, 64, 48, 10"):
        demo.known_scene(1, 64, 48, points=10)
