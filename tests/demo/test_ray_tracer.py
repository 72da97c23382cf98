"""Rays, hits and light of the demo's ray tracer, compared with closed forms."""

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.demo.ray_tracer import (
    SKY_LIGHT,
    SUN,
    SUN_LIGHT,
    Solid,
    bake,
    camera_rays,
    fibonacci,
    skylight,
    sunlight,
    trace,
)
from clsplat.demo.shapes import Cube, Lathe, Sphere, Square
from clsplat.demo.still_life import still_life

# Tolerance of float64 after a few dozen operations on numbers around 1.
EXACT = 1e-9

CYLINDER = Lathe((0, -1), (0.5, -1), (0.5, 1), (0, 1), rounds=0)
BOWL = Lathe((0, 0), (0.5, 0), (1, 0.6), (0.9, 0.6), (0.4, 0.1), (0, 0.1))
SHAPES = {"sphere": Sphere(), "cube": Cube(), "square": Square(), "cylinder": CYLINDER, "bowl": BOWL}


def column(*xyz):
    return np.array(xyz, dtype=float)[:, None]


def grey(p):
    return np.full_like(p, 0.5)


def rays_into(rng, n, radius=3.0):
    """Random rays from a sphere of the given radius to points around the origin."""
    o = rng.normal(size=(3, n))
    o *= radius / np.linalg.norm(o, axis=0)
    d = rng.uniform(-1, 1, (3, n)) - o
    return o, d / np.linalg.norm(d, axis=0)


@pytest.fixture
def rng():
    return np.random.default_rng(7)


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
        # Into a cup, past its rim, onto its bottom.
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
    # Nearly tangential rays are left out: their distance depends on the square root of the polyline's error.
    clear = np.abs(np.linalg.norm(np.cross(o.T, d.T), axis=1) - 1) > 1e-3
    true, found = Sphere().hit(o, d)[clear], lathe.hit(o, d)[clear]
    assert np.isfinite(true).any() and np.isinf(true).any()
    # Chords of 1/127 rad lie 8e-6 below the sphere. Along an oblique ray this is up to 20 times as far.
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
    np.testing.assert_allclose(again, p, atol=1e-7)  # near a pole, arccos loses half of the digits
    if not isinstance(shape, Lathe):  # its rounded normals may point away from a grazing ray
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
        # The component of the tangent along the normal is only rounding, 1e-16 / 1e-6.
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
    # Interpolation between texels a twentieth apart replaces arcs by chords and cuts corners.
    np.testing.assert_allclose(solid.lit(points), points, atol=0.03)


@pytest.mark.parametrize("bundle", ["from one point", "in one direction", "any"])
def test_bounding_spheres_lose_no_hit(bundle, rng):
    solids = still_life()
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
    # Where two surfaces meet, rounding decides which one is nearer: the chosen one must not be farther.
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
    # The disc's radius of 0.035 rad changes the mean cosine by at most 0.035^2.
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
