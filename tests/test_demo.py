"""The demo's photos: rays, hits and light against closed forms, the photos against their true cameras."""

from functools import partial

import numpy as np
import pytest
from PIL import ExifTags, Image
from scipy.ndimage import map_coordinates

from clsplat import demo
from clsplat.camera import Camera
from clsplat.errors import InputError
from clsplat.raytrace import (
    SKY_LIGHT,
    SUN,
    SUN_LIGHT,
    Cube,
    Lathe,
    Solid,
    Sphere,
    Square,
    bake,
    camera_rays,
    fibonacci,
    radiance,
    skylight,
    sunlight,
    trace,
)
from clsplat.still_life import still_life

# What remains of float64 after a few dozen operations on numbers around 1.
EXACT = 1e-9

CYLINDER = Lathe((0, -1), (0.5, -1), (0.5, 1), (0, 1), rounds=0)
BOWL = Lathe((0, 0), (0.5, 0), (1, 0.6), (0.9, 0.6), (0.4, 0.1), (0, 0.1))
SHAPES = {"sphere": Sphere(), "cube": Cube(), "square": Square(), "cylinder": CYLINDER, "bowl": BOWL}


def column(*xyz):
    return np.array(xyz, dtype=float)[:, None]


def grey(p):
    return np.full_like(p, 0.5)


def rays_into(rng, n, radius=3.0):
    """Rays from a sphere of the given radius to points around the origin."""
    o = rng.normal(size=(3, n))
    o *= radius / np.linalg.norm(o, axis=0)
    d = rng.uniform(-1, 1, (3, n)) - o
    return o, d / np.linalg.norm(d, axis=0)


@pytest.fixture
def rng():
    return np.random.default_rng(7)


@pytest.fixture(scope="module")
def solids():
    """The still life under a coarse light: a photo's other properties do not depend on the number of rays."""
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


def test_rays_pass_through_their_pixels(rng):
    camera = Camera.look_at((1, -3, 2), (0, 0.2, 0), (0, 0, 1), 500.0, 640, 480)
    x, y = rng.uniform(0, 640, 50), rng.uniform(0, 480, 50)
    d = camera_rays(camera, x, y)
    np.testing.assert_allclose(np.linalg.norm(d, axis=0), 1, atol=EXACT)
    points = camera.position[:, None] + rng.uniform(0.5, 9, 50) * d
    image = camera.K @ (camera.viewmat[:3, :3] @ points + camera.viewmat[:3, 3:])
    assert (image[2] > 0).all()
    np.testing.assert_allclose(image[:2] / image[2], [x, y], atol=1e-7)  # pixels, hence the larger bound


@pytest.mark.parametrize(
    ("shape", "origin", "direction", "distance"),
    [
        (Sphere(), (3, 0, 0), (-1, 0, 0), 2),
        (Sphere(), (3, 0.6, 0), (-1, 0, 0), 2.2),
        (Sphere(), (0, 0, 0), (0, 1, 0), 1),
        (Sphere(), (3, 1.01, 0), (-1, 0, 0), np.inf),
        (Sphere(), (3, 0, 0), (1, 0, 0), np.inf),
        (Cube(), (0.3, -5, 0.2), (0, 1, 0), 4),
        (Cube(), (4, 4, 0), (-(0.5**0.5), -(0.5**0.5), 0), 3 * 2**0.5),
        (Cube(), (0, 0, 0), (0, 0, 1), 1),
        (Cube(), (0, -5, 1.2), (0, 1, 0), np.inf),
        (Square(), (0.9, 0, 2), (0, 0, -1), 2),
        (Square(), (1.1, 0, 2), (0, 0, -1), np.inf),
        (Square(), (0, 0, 2), (1, 0, 0), np.inf),
        (CYLINDER, (3, 0, 0), (-1, 0, 0), 2.5),
        (CYLINDER, (3, 0.3, 0.9), (-1, 0, 0), 2.6),
        (CYLINDER, (0.2, 0.1, 3), (0, 0, -1), 2),
        (CYLINDER, (0, 0, 0), (0, 0.6, 0.8), 0.5 / 0.6),
        (CYLINDER, (3, 0, 1.1), (-1, 0, 0), np.inf),
        # The cone r = 1 - z, entered at r = 0.5.
        (Lathe((0, 0), (1, 0), (0, 1), rounds=0), (2, 0, 0.5), (-1, 0, 0), 1.5),
        # Into a cup: past its rim, onto its floor.
        (Lathe((0, 0), (1, 0), (1, 1), (0.9, 1), (0.9, 0.2), (0, 0.2), rounds=0), (0.5, 0, 3), (0, 0, -1), 2.8),
    ],
)
def test_known_hits(shape, origin, direction, distance):
    assert shape.hit(column(*origin), column(*direction))[0] == pytest.approx(distance, abs=EXACT)


def test_a_finely_turned_lathe_is_a_sphere(rng):
    angle = np.linspace(-np.pi / 2, np.pi / 2, 400)
    lathe = Lathe(*zip(np.cos(angle), np.sin(angle), strict=True), rounds=0)
    points, normals = lathe.surface(np.zeros(99), *rng.uniform(0.01, 0.99, (2, 99)))
    normals /= np.linalg.norm(normals, axis=0)
    np.testing.assert_allclose(points, normals, atol=1e-5)  # the height of an arc of 1/127 rad is 8e-6
    o, d = rays_into(rng, 500)
    # Rays that come within 1e-3 of a tangent are left out: there the distance is a root of the polyline's error.
    clear = np.abs(np.linalg.norm(np.cross(o.T, d.T), axis=1) - 1) > 1e-3
    true, found = Sphere().hit(o, d)[clear], lathe.hit(o, d)[clear]
    assert np.isfinite(true).any() and np.isinf(true).any()
    # Chords of 1/127 rad lie 8e-6 below the sphere; obliquely hit that is up to 20 times as far along the ray.
    np.testing.assert_allclose(found, true, atol=2e-4)


@pytest.mark.parametrize("name", SHAPES)
def test_hits_lie_on_the_surface_and_face_the_ray(name, rng):
    shape = SHAPES[name]
    o, d = rays_into(rng, 400)
    if name == "square":
        o[2] = np.abs(o[2])
        d = (rng.uniform(-1, 1, (3, 400)) * column(1, 1, 0)) - o
        d /= np.linalg.norm(d, axis=0)
    t = shape.hit(o, d)
    met = np.isfinite(t)
    assert met.sum() > 50
    p = o[:, met] + t[met] * d[:, met]
    face, u, v = shape.chart(p)
    assert min(u.min(), v.min()) >= -EXACT and max(u.max(), v.max()) <= 1 + EXACT
    again, normals = shape.surface(face, u, v)
    np.testing.assert_allclose(again, p, atol=1e-7)  # arccos near a pole halves the digits
    if not isinstance(shape, Lathe):  # whose rounded normals may turn away from a grazing ray
        assert ((normals * d[:, met]).sum(0) < 0).all()


@pytest.mark.parametrize("shape", [Sphere(), Cube(), Square()])
def test_normals_are_perpendicular_to_the_surface(shape, rng):
    face = rng.integers(0, shape.faces, 300)
    u, v = rng.uniform(0.01, 0.99, (2, 300))
    _, normals = shape.surface(face, u, v)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=0), 1, atol=EXACT)
    h = 1e-6
    for du, dv in ((h, 0), (0, h)):
        a, b = (shape.surface(face, u + s * du, v + s * dv)[0] for s in (-1, 1))
        # The rounding of the difference, 1e-16 / 1e-6, is all that is left of the tangent along the normal.
        np.testing.assert_allclose(((b - a) * normals).sum(0) / (2 * h), 0, atol=1e-8)


def test_solids_are_scaled_tilted_turned_and_moved():
    solid = Solid(Cube(), grey, (1, 2, 3), (1, 2, 3), yaw=90)
    assert solid.hit(column(9, 2, 3), column(-1, 0, 0))[0] == pytest.approx(6)  # half edge 2 along x
    assert solid.hit(column(1, 9, 3), column(0, -1, 0))[0] == pytest.approx(6)  # half edge 1 along y
    wall = Solid(Square(), grey, (0, 4, 1), (2, 1, 1), tilt=90)
    points, normals = wall.texel_surface()
    np.testing.assert_allclose(points[1], 4, atol=EXACT)
    np.testing.assert_allclose(normals, np.tile(column(0, -1, 0), points.shape[1]), atol=EXACT)
    turned = Solid(Square(), grey, (0, 0, 0), 1, yaw=90, tilt=90)
    np.testing.assert_allclose(turned.texel_surface()[1][:, 0], [1, 0, 0], atol=EXACT)
    ellipsoid = Solid(Sphere(), grey, (0, 0, 0), (1, 2, 1))
    points, normals = ellipsoid.texel_surface()
    gradient = points / column(1, 4, 1)
    np.testing.assert_allclose(normals, gradient / np.linalg.norm(gradient, axis=0), atol=EXACT)


@pytest.mark.parametrize("name", SHAPES)
def test_light_maps_are_read_where_they_were_written(name, rng):
    shape = SHAPES[name]
    solid = Solid(shape, grey, (0.1, 0.2, 0.3), (1, 0.8, 0.6), yaw=30, tilt=40, texels=64)
    solid.light = solid.texel_surface()[0].reshape(solid.light.shape)
    own, _ = shape.surface(rng.integers(0, shape.faces, 200), *rng.uniform(0, 1, (2, 200)))
    points = solid.turn @ (own * solid.size[:, None]) + solid.centre[:, None]
    # Between texels a twentieth apart the chords of a circle and the corners of a profile are cut.
    np.testing.assert_allclose(solid.lit(points), points, atol=0.03)


@pytest.mark.parametrize("bundle", ["from one point", "in one direction", "any"])
def test_bounding_spheres_lose_no_hit(bundle, solids, rng):
    n = 3000
    origins = rng.uniform(-2, 2, (3, n)) + column(0, 0, 2.1)
    directions = rng.normal(size=(3, n)) * 0.3 + column(0.3, 0.2, -1)
    directions /= np.linalg.norm(directions, axis=0)
    if bundle == "from one point":
        origins = origins[:, :1]
    if bundle == "in one direction":
        directions = directions[:, :1]
    t, which = trace(origins, directions, solids)
    o, d = np.broadcast_arrays(origins, directions)
    every = np.array([solid.hit(o, d) for solid in solids])
    np.testing.assert_allclose(t, every.min(0), atol=EXACT)
    hit = np.flatnonzero(np.isfinite(t))
    assert (np.delete(which, hit) == -1).all()
    # Where two surfaces meet, rounding decides which comes first: the one taken must be no farther.
    np.testing.assert_allclose(every[which[hit], hit], every.min(0)[hit], atol=EXACT)
    assert len(np.unique(which)) > 5


def test_a_bundle_may_be_empty_or_miss():
    t, which = trace(np.zeros((3, 0)), column(0, 0, 1), [Solid(Sphere(), grey, (0, 0, 9), 1)])
    assert t.shape == which.shape == (0,)
    t, which = trace(np.zeros((3, 1)), column(0, 0, -1), [Solid(Sphere(), grey, (0, 0, 9), 1)])
    assert np.isinf(t[0]) and which[0] == -1


def test_open_ground_gets_the_whole_sun_and_sky():
    far = [Solid(Sphere(), grey, (0, 0, -99), 1)]
    up = column(0, 0, 1)
    np.testing.assert_allclose(np.linalg.norm(SUN), 1, atol=EXACT)
    # The disc's radius of 0.035 rad moves the mean of its cosines by at most 0.035^2.
    np.testing.assert_allclose(sunlight(0 * up, up, far, 10)[:, 0], SUN_LIGHT * SUN[2], rtol=2e-3)
    # Mean of 0.6 + 0.4 cos over a hemisphere weighted by cos: 0.6 + 0.4 * 2/3; 500 rays integrate it to 1 %.
    np.testing.assert_allclose(skylight(0 * up, up, far, 500)[:, 0], SKY_LIGHT * (0.6 + 0.8 / 3), rtol=0.01)
    np.testing.assert_allclose(fibonacci(500) @ fibonacci(500).T / 500, np.eye(3) / 3, atol=1e-3)


def test_solids_cast_shadows_and_send_light_back():
    above = [Solid(Sphere(), grey, 4 * SUN, 1)]
    up = column(0, 0, 1)
    assert (sunlight(0 * up, up, above, 10) == 0).all()
    ground = Solid(Square(), grey, (0, 0, 0), 1e3, texels=2)
    bake([ground], sun_rays=4, sky_rays=200)
    np.testing.assert_allclose(ground.albedo, 0.5, atol=EXACT)
    down = skylight(column(0, 0, 1e-2), -up, [ground], 200)[:, 0]
    np.testing.assert_allclose(down, 0.5 * (ground.light[:, 0, 0, 0] + SKY_LIGHT / 4), rtol=0.02)


def test_a_point_has_one_colour_in_all_views(solids, rng):
    points = np.stack([*rng.uniform(-1, 1, (2, 600)), np.full(600, 0.012)])
    eyes = (np.array([1.5, -2.0, 2.4]), np.array([-2.2, 0.4, 1.9]))
    colours, seen = [], np.full(600, True)
    for eye in eyes:
        d = points - eye[:, None]
        distance = np.linalg.norm(d, axis=0)
        seen &= np.abs(trace(eye[:, None], d / distance, solids)[0] - distance) < 1e-6
        colours.append(radiance(eye, d / distance, solids))
    assert seen.sum() > 50
    np.testing.assert_allclose(colours[0][:, seen], colours[1][:, seen], atol=1e-6)  # edges turn EXACT into more
    assert colours[0][:, seen].std(axis=1).min() > 0.1


def test_photos_agree_where_they_show_the_same_points(photos, cameras, solids, rng):
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
    # At a third of the size textures blur differently from view to view: 0.011 here, 0.17 for other points.
    assert np.median(same) < 0.02
    assert np.median(other) > 8 * np.median(same)


@pytest.mark.parametrize("offset", [-0.2, 0.2])
@pytest.mark.parametrize("axis", [0, 1])
def test_pixels_lie_where_the_camera_has_them(axis, offset):
    edge = 5 + offset * 2 / 10  # pixels times distance by focal length
    board = Solid(Square(), grey, np.array([[0, edge, 0], [edge, 0, 0]])[axis], 5)
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
        # A flat surface under the sensor's noise would show 0.005: matching needs a multiple of it everywhere.
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
    # The noise of the sensor and the rounding of the JPEG, mean 0.012; another camera's photo differs by 0.22.
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
    from clsplat.sfm import reconstruct

    cameras = demo.make_photos(tmp_path / "images")
    model = pycolmap.Reconstruction(reconstruct(tmp_path, SfmConfig()))
    assert model.num_reg_images() == len(cameras)
    assert model.compute_mean_reprojection_error() < 0.5  # pixels: 0.3 was seen
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
    assert np.linalg.norm(found - true, axis=1).max() < 0.005 * radius  # 0.0012 was seen
    for k, camera in enumerate(cameras):
        turn = poses[k][:, :3] @ rotation.T @ camera.viewmat[:3, :3].T
        assert np.degrees(np.arccos((np.trace(turn) - 1) / 2)) < 0.2  # 0.06 was seen


def test_the_known_scene_knows_its_cameras_and_points():
    scene = demo.known_scene(9, 64, 48, points=300)
    assert [v.name for v in scene.test] == ["000.png", "008.png"] and len(scene.train) == 7
    assert 200 < len(scene.points) <= 300 and scene.colors.shape == scene.points.shape
    # Each point was seen by one photo: of those that have it in the image, one has its colour there, to the bit.
    matched = np.zeros(len(scene.points), bool)
    for view in scene.train:
        p = scene.points @ view.camera.viewmat[:3, :3].T + view.camera.viewmat[:3, 3]
        x, y = (p[:, :2] / p[:, 2:] * [view.camera.fx, view.camera.fy] + [view.camera.cx, view.camera.cy]).T
        inside = (p[:, 2] > 0) & (x >= 0) & (x < 64) & (y >= 0) & (y < 48)
        rows = np.flatnonzero(inside)
        matched[rows] |= (view.image[y[rows].astype(int), x[rows].astype(int)] == scene.colors[rows]).all(axis=1)
    # A ray within rounding of a pixel's edge may fall into the neighbour.
    assert matched.mean() > 0.99
    again = demo.known_scene(9, 64, 48, points=300)
    assert (again.points == scene.points).all() and (again.train[3].image == scene.train[3].image).all()


def test_the_known_scene_wants_photos():
    with pytest.raises(InputError, match="expected at least 2, 1, 1 and 1, found 1, 64, 48, 10"):
        demo.known_scene(1, 64, 48, points=10)
