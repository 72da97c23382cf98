"""A small ray tracer in float64 NumPy. It shares only the camera with the splatting code.

It renders the photos of `clsplat.demo` from analytic solids whose textures are functions of the point. The light of a
sun and a sky, with one bounce, is baked into one light map per solid. All surfaces are Lambertian, so that a point
has the same colour in every photo. World units are metres, z is up. Points, directions and linear RGB are (3, N), so
that ``x, y, z = points`` unpacks.
"""

from collections.abc import Callable

import numpy as np

from clsplat.camera import Camera
from clsplat.demo.shapes import Array, Cube, Lathe, Sphere, Square

Texture = Callable[[Array], Array]

LIFT = 1e-4
"""Height above a surface at which its light is gathered, m. It is larger than T_MIN and smaller than the thinnest
solid."""

SUN = np.array([0.48, -0.36, 0.8])
"""Direction to the centre of the sun, a unit vector."""
SUN_RADIUS = 0.035
"""Angular radius of the sun's disc, radians. It is seven times the real one, as in haze, so that shadows are soft."""
SUN_LIGHT = np.array([2.6, 2.24, 1.72])
SKY_LIGHT = np.array([0.53, 0.66, 0.85])
"""Irradiance of a surface that faces the sun, and radiance of the sky at the zenith; linear RGB."""

CHUNK = 1 << 14
"""Number of texels lit at once. Their arrays fit into a core's cache, and are long enough to hide the overhead of a
call."""


class Solid:
    """A shape in the world: scaled along its axes, then tilted about x, turned about z, and moved.

    Parameters
    ----------
    shape : Sphere, Cube, Square or Lathe
    texture : callable
        Albedo (3, N) at points (3, N) relative to the solid's centre, along its axes, m.
    centre : (3,)
        Position in the world, m.
    size : float or (3,)
        Scale factors along the shape's axes.
    yaw, tilt : float
        Angles about z and x, degrees.
    texels : int
        Edge of each face of the light map, texels.
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
        """Convert points of the world to the shape's coordinates."""
        return self.inverse @ points - (self.inverse @ self.centre)[:, None]

    def hit(self, origins: Array, directions: Array) -> Array:
        """Distances (N,) of the first hits of rays in the world, m."""
        return self.shape.hit(self.own(origins), self.inverse @ directions)

    def texel_surface(self) -> tuple[Array, Array]:
        """Points and unit normals of the light map's texels in the world, row by row."""
        n = self.light.shape[-1]
        face, u, v = (a.ravel() for a in np.mgrid[0 : self.shape.faces, 0:n, 0:n])
        own, normals = self.shape.surface(face, u / (n - 1), v / (n - 1))
        normals = self.inverse.T @ normals
        points = self.turn @ (own * self.size[:, None]) + self.centre[:, None]
        return points, normals / np.linalg.norm(normals, axis=0)

    def lit(self, points: Array) -> Array:
        """Irradiance divided by pi at points of the surface, linear RGB (3, N)."""
        from scipy.ndimage import map_coordinates

        face, u, v = self.shape.chart(self.own(points))
        n = self.light.shape[-1] - 1
        places = np.stack([face, u * n, v * n])
        return np.stack([map_coordinates(c, places, order=1, mode="nearest") for c in self.light])

    def colour(self, points: Array) -> Array:
        """Albedo at points of the surface, (3, N)."""
        return self.texture(self.turn.T @ (points - self.centre[:, None])).clip(0.01, 0.95)


def within_reach(origins: Array, directions: Array, solids: list[Solid]) -> Array:
    """Indices of the solids whose bounding spheres meet the cone around a bundle of rays."""
    start, axis = origins.mean(1), directions.mean(1)
    axis /= np.linalg.norm(axis)
    spread = np.arccos(np.clip(axis @ directions, -1, 1).min())
    to = np.array([solid.middle for solid in solids]) - start
    reach = np.array([solid.radius for solid in solids]) + np.linalg.norm(origins.T - start, axis=1).max()
    distance = np.linalg.norm(to, axis=1).clip(1e-9)
    angle = np.arccos(np.clip(to @ axis / distance, -1, 1))
    # 1e-6 covers the rounding of the arc cosines, which is large near 1.
    return np.flatnonzero((distance <= reach) | (angle < spread + np.arcsin(np.minimum(reach / distance, 1)) + 1e-6))


def trace(origins: Array, directions: Array, solids: list[Solid]) -> tuple[Array, Array]:
    """Distance to the first hit and index of the solid, (N,) each; infinity and -1 for rays without a hit.

    Origins and unit directions are (3, N), or (3, 1) if all rays share them.
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
    """Unit directions (3, count), spread evenly over the sphere on a golden-angle spiral."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (3 - 5**0.5) * np.arange(count)
    return np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z])


def sunlight(points: Array, normals: Array, solids: list[Solid], count: int) -> Array:
    """Irradiance divided by pi from `count` points of the sun's disc, (3, N)."""
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
    """Irradiance divided by pi, (3, N), from the sky and from the solids, which reflect the light gathered so far."""
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
            # A quarter of the sky's light approximates further bounces.
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
    """Unit directions (3, N), in the world, of the rays through image points. `x` and `y` are (N,) each, px."""
    return camera.viewmat[:3, :3].T @ camera.rays(x, y).T


def radiance(origin: Array, directions: Array, solids: list[Solid]) -> Array:
    """Linear RGB (3, N) that `origin` (3,) receives from unit directions (3, N)."""
    t, which = trace(origin[:, None], directions, solids)
    rgb = np.repeat(SKY_LIGHT[:, None], directions.shape[1], axis=1)
    for k in np.unique(which[which >= 0]):
        rows = np.flatnonzero(which == k)
        points = origin[:, None] + t[rows] * directions[:, rows]
        rgb[:, rows] = solids[k].colour(points) * solids[k].lit(points)
    return rgb
