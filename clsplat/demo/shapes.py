"""Shapes that rays can hit: sphere, cube, square, and surfaces of revolution.

Each shape lies around the origin of its own coordinates. Points and directions are (3, N), so that ``x, y, z =
points`` unpacks.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

T_MIN = 1e-6
"""Smallest distance of a hit, m. A nearer hit is the surface that the ray starts from. The rounding of float64 is far
smaller."""


class Sphere:
    """The unit sphere."""

    faces = 1
    bound = (0.0, 1.0)
    """z of the centre of a bounding sphere, and its radius."""

    def hit(self, o: Array, d: Array) -> Array:
        """Distance t (N,) of the first hit of the rays o + t d, or infinity. o and d are (3, N) or (3, 1)."""
        a, b, c = (d * d).sum(0), (o * d).sum(0), (o * o).sum(0) - 1
        square = b * b - a * c
        root = np.sqrt(np.maximum(square, 0))
        near, far = (-b - root) / a, (-b + root) / a
        t = np.where(near > T_MIN, near, far)
        return np.where((square >= 0) & (t > T_MIN), t, np.inf)

    def chart(self, p: Array) -> tuple[Array, Array, Array]:
        """Face of the light map, and the two coordinates on it in [0, 1], for points of the surface; (N,) each."""
        x, y, z = p
        return np.zeros_like(x), np.arctan2(y, x) / (2 * np.pi) + 0.5, np.arccos(np.clip(z, -1, 1)) / np.pi

    def surface(self, face: Array, u: Array, v: Array) -> tuple[Array, Array]:
        """Points and outward normals for coordinates on the light map: the inverse of `chart`."""
        theta, phi = 2 * np.pi * (u - 0.5), np.pi * v
        p = np.stack([np.cos(theta) * np.sin(phi), np.sin(theta) * np.sin(phi), np.cos(phi)])
        return p, p


class Cube:
    """The cube [-1, 1]^3. Methods as in `Sphere`."""

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
    """The square [-1, 1]^2 at z = 0, facing +z. Methods as in `Sphere`."""

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
    """A surface of revolution about z. Methods as in `Sphere`.

    Parameters
    ----------
    *profile : (radius, z)
        Corners of the line that is turned. The outside is on its right: up along the outer wall, down along the inner
        one.
    rounds : int
        Number of rounds of corner cutting, at a quarter of the edges (Chaikin 1974).
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
        # A ray along a cone's side or a ring divides by zero. The resulting NaN or infinity fails every comparison.
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
