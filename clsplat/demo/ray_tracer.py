"""A small ray tracer in float64 NumPy, which shares nothing with the splatting code but the camera.

It makes the photos of `clsplat.demo`: analytic solids, textures as functions of the point, and the light of a
sun and a sky, with one bounce, baked into one light map per solid. All surfaces are Lambertian, so that a point
has the same colour in every photo. World units are metres, z is up. Points, directions and linear RGB are
(3, N), so that ``x, y, z = points`` unpacks.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera

Array = NDArray[Any]
Texture = Callable[[Array], Array]

T_MIN = 1e-6
"""Hits nearer than this, in metres, are the surface that the ray starts from: float64 rounding stays far below."""

LIFT = 1e-4
"""Metres by which light is gathered above a surface: more than T_MIN, less than the thinnest solid."""

SUN = np.array([0.48, -0.36, 0.8])
"""Direction towards the middle of the sun."""
SUN_RADIUS = 0.035
"""Of the sun's disc, in radians: seven times the real one, as through thin haze, so that shadows are soft."""
SUN_LIGHT = np.array([2.6, 2.24, 1.72])
SKY_LIGHT = np.array([0.53, 0.66, 0.85])
"""Irradiance of a surface that faces the sun, radiance of the sky at the zenith; linear RGB."""

CHUNK = 1 << 14
"""Texels lit at once: their arrays stay in a core's cache, and are long enough to outweigh a call."""


class Sphere:
    """The unit sphere."""

    faces = 1
    bound = (0.0, 1.0)
    """z of the middle of a bounding sphere, and its radius."""

    def hit(self, o: Array, d: Array) -> Array:
        """Distance t, (N,), at which the rays o + t d, (3, N) or (3, 1) each, first meet the shape, or infinity."""
        a, b, c = (d * d).sum(0), (o * d).sum(0), (o * o).sum(0) - 1
        square = b * b - a * c
        root = np.sqrt(np.maximum(square, 0))
        near, far = (-b - root) / a, (-b + root) / a
        t = np.where(near > T_MIN, near, far)
        return np.where((square >= 0) & (t > T_MIN), t, np.inf)

    def chart(self, p: Array) -> tuple[Array, Array, Array]:
        """Face of the light map and place in [0, 1]^2 on it, (N,) each, of points of the surface."""
        x, y, z = p
        return np.zeros_like(x), np.arctan2(y, x) / (2 * np.pi) + 0.5, np.arccos(np.clip(z, -1, 1)) / np.pi

    def surface(self, face: Array, u: Array, v: Array) -> tuple[Array, Array]:
        """Points and outward normals at places of the light map: the inverse of `chart`."""
        theta, phi = 2 * np.pi * (u - 0.5), np.pi * v
        p = np.stack([np.cos(theta) * np.sin(phi), np.sin(theta) * np.sin(phi), np.cos(phi)])
        return p, p


class Cube:
    """The cube [-1, 1]^3; methods as in `Sphere`."""

    faces = 6
    bound = (0.0, 3**0.5)

    def hit(self, o: Array, d: Array) -> Array:
        inverse = 1 / np.where(d == 0, 1e-30, d)
        a, b = (-1 - o) * inverse, (1 - o) * inverse
        near, far = np.minimum(a, b).max(0), np.maximum(a, b).min(0)
        t = np.where(near > T_MIN, near, far)
        return np.where((near <= far) & (t > T_MIN), t, np.inf)

    def chart(self, p: Array) -> tuple[Array, Array, Array]:
        axis = np.abs(p).argmax(0)
        rows = np.arange(p.shape[1])
        u, v = p[(axis + 1) % 3, rows], p[(axis + 2) % 3, rows]
        return 2 * axis + (p[axis, rows] > 0), (u + 1) / 2, (v + 1) / 2

    def surface(self, face: Array, u: Array, v: Array) -> tuple[Array, Array]:
        axis, rows = face // 2, np.arange(len(face))
        p, n = np.zeros((3, len(face))), np.zeros((3, len(face)))
        p[axis, rows] = n[axis, rows] = 2 * (face % 2) - 1
        p[(axis + 1) % 3, rows], p[(axis + 2) % 3, rows] = 2 * u - 1, 2 * v - 1
        return p, n


class Square:
    """The square [-1, 1]^2 at z = 0, facing +z; methods as in `Sphere`."""

    faces = 1
    bound = (0.0, 2**0.5)

    def hit(self, o: Array, d: Array) -> Array:
        t = -o[2] / np.where(d[2] == 0, 1e-30, d[2])
        inside = np.maximum(np.abs(o[0] + t * d[0]), np.abs(o[1] + t * d[1])) <= 1
        return np.where(inside & (t > T_MIN), t, np.inf)

    def chart(self, p: Array) -> tuple[Array, Array, Array]:
        return np.zeros_like(p[0]), (p[0] + 1) / 2, (p[1] + 1) / 2

    def surface(self, face: Array, u: Array, v: Array) -> tuple[Array, Array]:
        zero = np.zeros_like(u)
        return np.stack([2 * u - 1, 2 * v - 1, zero]), np.stack([zero, zero, zero + 1])


class Lathe:
    """A surface of revolution about z; methods as in `Sphere`.

    Parameters
    ----------
    *profile : (radius, z)
        Corners of the turned line, the outside on its right: up along the outer wall, down along the inner one.
    rounds : int
        Times that every corner is cut at a quarter of its edges (Chaikin 1974).
    """

    faces = 1

    def __init__(self, *profile: tuple[float, float], rounds: int = 1) -> None:
        line = np.array(profile, dtype=np.float64)
        for _ in range(rounds):
            a, b = line[:-1], line[1:]
            cut = np.stack([0.75 * a + 0.25 * b, 0.25 * a + 0.75 * b], axis=1).reshape(-1, 2)
            line = np.concatenate([line[:1], cut, line[-1:]])
        self.line = line
        edges = np.diff(line, axis=0)
        length = np.hypot(*edges.T)
        self.place = np.concatenate([[0], np.cumsum(length)]) / length.sum()
        side = np.stack([edges[:, 1], -edges[:, 0]], axis=1) / length[:, None]
        self.normals = np.concatenate([side[:1], side[:-1] + side[1:], side[-1:]])
        middle = (line[:, 1].min() + line[:, 1].max()) / 2
        self.bound = (float(middle), float(np.hypot(line[:, 0], line[:, 1] - middle).max()))

    def hit(self, o: Array, d: Array) -> Array:
        dd, od, oo = d[0] ** 2 + d[1] ** 2, o[0] * d[0] + o[1] * d[1], o[0] ** 2 + o[1] ** 2
        nearest = np.full(od.shape, np.inf)
        # A division by zero is a ray along a cone's side or a ring: its NaN or infinity fails every comparison.
        with np.errstate(divide="ignore", invalid="ignore"):
            for (r0, z0), (r1, z1) in zip(self.line[:-1], self.line[1:], strict=True):
                if z0 == z1:
                    t = (z0 - o[2]) / d[2]
                    rr = oo + t * (2 * od + t * dd)
                    valid = (rr >= min(r0, r1) ** 2) & (rr <= max(r0, r1) ** 2)
                    nearest = np.where(valid & (t > T_MIN) & (t < nearest), t, nearest)
                    continue
                slope = (r1 - r0) / (z1 - z0)
                r = r0 + slope * (o[2] - z0)
                a = dd - (slope * d[2]) ** 2
                b = od - slope * d[2] * r
                root = np.sqrt(b * b - a * (oo - r * r))
                for t in ((-b - root) / a, (-b + root) / a):
                    z = o[2] + t * d[2]
                    valid = (z >= min(z0, z1)) & (z <= max(z0, z1))
                    nearest = np.where(valid & (t > T_MIN) & (t < nearest), t, nearest)
        return nearest

    def chart(self, p: Array) -> tuple[Array, Array, Array]:
        r, z = np.hypot(p[0], p[1]), p[2]
        place, nearest = np.zeros_like(z), np.full_like(z, np.inf)
        for k, ((r0, z0), (r1, z1)) in enumerate(zip(self.line[:-1], self.line[1:], strict=True)):
            dr, dz = r1 - r0, z1 - z0
            s = np.clip(((r - r0) * dr + (z - z0) * dz) / (dr * dr + dz * dz), 0, 1)
            off = (r - r0 - s * dr) ** 2 + (z - z0 - s * dz) ** 2
            place = np.where(off < nearest, self.place[k] + s * (self.place[k + 1] - self.place[k]), place)
            nearest = np.minimum(off, nearest)
        return np.zeros_like(z), np.arctan2(p[1], p[0]) / (2 * np.pi) + 0.5, place

    def surface(self, face: Array, u: Array, v: Array) -> tuple[Array, Array]:
        r, z, nr, nz = (np.interp(v, self.place, c) for c in (*self.line.T, *self.normals.T))
        c, s = np.cos(2 * np.pi * (u - 0.5)), np.sin(2 * np.pi * (u - 0.5))
        return np.stack([r * c, r * s, z]), np.stack([nr * c, nr * s, nz])


class Solid:
    """A shape in the world: scaled along its axes, tilted about x, turned about z, moved.

    Parameters
    ----------
    shape : Sphere, Cube, Square or Lathe
    texture : callable
        Albedo (3, N) at points (3, N) in metres, in the solid's axes, from its centre.
    centre : (3,)
        Metres.
    size : float or (3,)
        Factors on the shape's axes.
    yaw, tilt : float
        Degrees.
    texels : int
        Edge of each face of the light map.
    """

    def __init__(
        self,
        shape: Sphere | Cube | Square | Lathe,
        texture: Texture,
        centre: object,
        size: object,
        yaw: float = 0.0,
        tilt: float = 0.0,
        texels: int = 32,
    ) -> None:
        a, b = np.radians([yaw, tilt])
        about_z = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
        about_x = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
        self.shape, self.texture = shape, texture
        self.turn = about_z @ about_x
        self.centre = np.asarray(centre, dtype=np.float64)
        self.size = np.broadcast_to(np.asarray(size, dtype=np.float64), 3)
        self.inverse = self.turn.T / self.size[:, None]
        height, radius = shape.bound
        self.middle = self.centre + self.turn[:, 2] * self.size[2] * height
        self.radius = radius * float(self.size.max())
        self.light = np.zeros((3, shape.faces, texels, texels))
        self.albedo = np.zeros(3)

    def own(self, points: Array) -> Array:
        """Points of the world in the shape's coordinates."""
        return self.inverse @ points - (self.inverse @ self.centre)[:, None]

    def hit(self, origins: Array, directions: Array) -> Array:
        """Distances, (N,), to the first hit of rays in the world."""
        return self.shape.hit(self.own(origins), self.inverse @ directions)

    def texel_surface(self) -> tuple[Array, Array]:
        """Points and unit normals in the world of the light map's texels, row by row."""
        n = self.light.shape[-1]
        face, u, v = (a.ravel() for a in np.mgrid[0 : self.shape.faces, 0:n, 0:n])
        own, normals = self.shape.surface(face, u / (n - 1), v / (n - 1))
        normals = self.inverse.T @ normals
        points = self.turn @ (own * self.size[:, None]) + self.centre[:, None]
        return points, normals / np.linalg.norm(normals, axis=0)

    def lit(self, points: Array) -> Array:
        """Irradiance over pi, linear RGB (3, N), at points of the surface."""
        from scipy.ndimage import map_coordinates

        face, u, v = self.shape.chart(self.own(points))
        n = self.light.shape[-1] - 1
        places = np.stack([face, u * n, v * n])
        return np.stack([map_coordinates(c, places, order=1, mode="nearest") for c in self.light])

    def colour(self, points: Array) -> Array:
        """Albedo (3, N) at points of the surface."""
        return self.texture(self.turn.T @ (points - self.centre[:, None])).clip(0.01, 0.95)


def within_reach(origins: Array, directions: Array, solids: list[Solid]) -> Array:
    """Indices of the solids that a bundle of rays can meet: bounding spheres against the cone around the rays."""
    start, axis = origins.mean(1), directions.mean(1)
    axis /= np.linalg.norm(axis)
    spread = np.arccos(np.clip(axis @ directions, -1, 1).min())
    to = np.array([solid.middle for solid in solids]) - start
    reach = np.array([solid.radius for solid in solids]) + np.linalg.norm(origins.T - start, axis=1).max()
    distance = np.linalg.norm(to, axis=1).clip(1e-9)
    angle = np.arccos(np.clip(to @ axis / distance, -1, 1))
    # 1e-6 covers the rounding of the arc cosines, which flatten out at 1.
    return np.flatnonzero((distance <= reach) | (angle < spread + np.arcsin(np.minimum(reach / distance, 1)) + 1e-6))


def trace(origins: Array, directions: Array, solids: list[Solid]) -> tuple[Array, Array]:
    """Distance to the first hit and index of the solid, (N,) each: infinity and -1 where there is none.

    Origins and unit directions are (3, N), or (3, 1) where all rays share them.
    """
    n = np.broadcast_shapes(origins.shape, directions.shape)[1]
    nearest, which = np.full(n, np.inf), np.full(n, -1)
    if n == 0:
        return nearest, which
    od, oo = (origins * directions).sum(0), (origins * origins).sum(0)
    for k in within_reach(origins, directions, solids):
        solid = solids[k]
        along = solid.middle @ directions - od
        aside = oo - 2 * (solid.middle @ origins) + solid.middle @ solid.middle - along * along
        reach = solid.radius
        rows = np.flatnonzero((aside < reach**2) & (along > -reach) & (along - reach < nearest))
        if len(rows):
            t = solid.hit(*(a if a.shape[1] == 1 else a.take(rows, axis=1) for a in (origins, directions)))
            closer = t < nearest[rows]
            rows = rows[closer]
            nearest[rows] = t[closer]
            which[rows] = k
    return nearest, which


def fibonacci(count: int) -> Array:
    """Unit directions (3, count) spread evenly over the sphere: a golden-angle spiral."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (3 - 5**0.5) * np.arange(count)
    return np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z])


def sunlight(points: Array, normals: Array, solids: list[Solid], count: int) -> Array:
    """Irradiance over pi from `count` points of the sun's disc, (3, N)."""
    angle = np.pi * (3 - 5**0.5) * np.arange(count)
    radius = SUN_RADIUS * np.sqrt((np.arange(count) + 0.5) / count)
    east = np.cross([0, 0, 1], SUN) / np.hypot(*SUN[:2])
    disc = SUN[:, None] + radius * (np.cos(angle) * east[:, None] + np.sin(angle) * np.cross(SUN, east)[:, None])
    light = np.zeros_like(points)
    for direction in (disc / np.linalg.norm(disc, axis=0)).T:
        cosine = direction @ normals
        rows = np.flatnonzero(cosine > 0)
        t, _ = trace(points[:, rows], direction[:, None], solids)
        light[:, rows] += np.where(np.isinf(t), cosine[rows], 0) * SUN_LIGHT[:, None] / count
    return light


def skylight(points: Array, normals: Array, solids: list[Solid], count: int) -> Array:
    """Irradiance over pi, (3, N), from the sky and from what the solids reflect of their light so far."""
    light = np.zeros_like(points)
    for direction in fibonacci(count).T:
        cosine = direction @ normals
        rows = np.flatnonzero(cosine > 0)
        t, which = trace(points[:, rows], direction[:, None], solids)
        sky = SKY_LIGHT * (0.6 + 0.4 * max(direction[2], 0))
        radiance = np.repeat(sky[:, None], len(rows), axis=1)
        for k in np.unique(which[which >= 0]):
            hit = which == k
            place = points[:, rows[hit]] + t[hit] * direction[:, None]
            # A quarter of the sky stands for the light that arrives there by further bounces.
            radiance[:, hit] = solids[k].albedo[:, None] * (solids[k].lit(place) + SKY_LIGHT[:, None] / 4)
        light[:, rows] += radiance * cosine[rows] * 4 / count
    return light


def bake(solids: list[Solid], sun_rays: int = 10, sky_rays: int = 96) -> None:
    """Fill the light maps and mean albedos of all solids."""
    surfaces = [solid.texel_surface() for solid in solids]
    for solid, (points, _) in zip(solids, surfaces, strict=True):
        solid.albedo = solid.colour(points).mean(1)
    points, normals = np.concatenate(surfaces, axis=2)
    points = points + LIFT * normals
    ends = np.cumsum([solid.light[0].size for solid in solids])[:-1]
    for gather, count in ((sunlight, sun_rays), (skylight, sky_rays)):
        light = np.zeros_like(points)
        for start in range(0, points.shape[1], CHUNK):
            chunk = np.s_[:, start : start + CHUNK]
            light[chunk] = gather(points[chunk], normals[chunk], solids, count)
        for solid, part in zip(solids, np.split(light, ends, axis=1), strict=True):
            solid.light = solid.light + part.reshape(solid.light.shape)


def camera_rays(camera: Camera, x: Array, y: Array) -> Array:
    """Unit directions (3, N) in the world of the rays through the image points `x`, `y` in pixels, (N,) each."""
    return camera.viewmat[:3, :3].T @ camera.rays(x, y).T


def radiance(origin: Array, directions: Array, solids: list[Solid]) -> Array:
    """Linear RGB (3, N) that arrives at `origin` (3,) against unit directions (3, N)."""
    t, which = trace(origin[:, None], directions, solids)
    rgb = np.repeat(SKY_LIGHT[:, None], directions.shape[1], axis=1)
    for k in np.unique(which[which >= 0]):
        rows = np.flatnonzero(which == k)
        points = origin[:, None] + t[rows] * directions[:, rows]
        rgb[:, rows] = solids[k].colour(points) * solids[k].lit(points)
    return rgb
