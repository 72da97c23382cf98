"""The scene of `clsplat.demo`: a still life in a courtyard with procedural textures.

A texture maps points (3, N), in metres from the solid's centre, to albedos (3, N). It depends only on the point, so
that all photos agree. It is irregular everywhere, so that photos can be matched.
"""

import numpy as np

from clsplat.demo.ray_tracer import Solid, Texture
from clsplat.demo.shapes import Array, Cube, Lathe, Sphere, Square

LATTICE = np.random.default_rng(20).random((32, 32, 32))
CELLS = np.random.default_rng(21).random(4096)
OBLIQUE = np.array([[2, 2, -1], [-1, 2, 2], [2, -1, 2]]) / 3
"""Random values on a lattice, random values of cells, and a rotation that turns the lattice out of the solids' axes,
so that it is not visible."""


def noise(points: Array) -> Array:
    """Value noise in [0, 1] with details of about one unit, (N,) (Perlin 1985, with values instead of gradients)."""
    from scipy.ndimage import map_coordinates

    points = OBLIQUE @ points
    cell = np.floor(points)
    f = points - cell
    return map_coordinates(LATTICE, cell + f * f * (3 - 2 * f), order=1, mode="grid-wrap")


def fractal(points: Array, octaves: int = 3) -> Array:
    """Sum of octaves of `noise`, each with half the size and half the amplitude, stretched to about [0, 1]."""
    total = np.full(points.shape[1], 0.5)
    for k in range(octaves):
        total += 0.9 * (noise(points * 2.0**k + 7.7 * k) - 0.5) * 0.5**k
    return np.clip(total, 0, 1)


def cell_random(*indices: Array) -> Array:
    """Random number in [0, 1) for each cell of a pattern, determined by the cell's integer indices."""
    code = sum(i.astype(np.int64) * k for i, k in zip(indices, (1, 61, 1009), strict=False))
    return CELLS[code % len(CELLS)]


def linear(colour: str) -> Array:
    """Albedo (3, 1) of an sRGB colour "rrggbb"."""
    c = np.frombuffer(bytes.fromhex(colour), np.uint8)[:, None] / 255
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def ramp(x: Array, *colours: str) -> Array:
    """Albedos (3, N): interpolation between equally spaced sRGB colours, for x from 0 to 1."""
    knots = np.linspace(0, 1, len(colours))
    return np.stack([np.interp(x, knots, c) for c in np.hstack([linear(c) for c in colours])])


def mix(a: Array, b: Array, t: Array) -> Array:
    """Interpolate linearly from a, at t = 0, to b, at t = 1."""
    return a + (b - a) * t


def edge(x: Array, width: float) -> Array:
    """Ramp from 0 to 1 around x = 0 over the given width."""
    return np.clip(x / width + 0.5, 0, 1)


def cells(u: Array, v: Array, width: float, height: float, shift: float) -> tuple[Array, Array, Array]:
    """Row, column and distance to the border of the cells of a brick bond with randomly shifted rows."""
    row = np.floor(v / height)
    u = u / width + shift * cell_random(row)
    column = np.floor(u)
    u, v = u - column, v / height - row
    return row, column, np.minimum(np.minimum(u, 1 - u) * width, np.minimum(v, 1 - v) * height)


def wood(dark: str, light: str, scale: float = 1.0) -> Texture:
    """Wood with annual rings around the x axis and streaks along it."""

    def texture(p: Array) -> Array:
        x, y, z = p * scale
        bend = noise(np.stack([x * 1.5, y * 4, z * 4]))
        ring = 0.5 - 0.5 * np.cos(40 * np.hypot(y + 0.21, z + 0.17) + 9 * bend)
        streak = noise(np.stack([x * 6, y * 90, z * 90]))
        return ramp(0.45 * ring + 0.35 * streak + 0.3 * noise(p * 9) - 0.05, dark, light)

    return texture


FLOORBOARD = wood("5d3c22", "b98a5a", 0.6)


def floorboards(p: Array) -> Array:
    row, column, border = cells(p[0], p[1], 1.9, 0.21, 5.0)
    other = row * 1.37 + column * 0.48
    grain = FLOORBOARD(np.stack([p[0], p[1] + other, other * 0.3]))
    worn = 0.65 + 0.5 * cell_random(row, column) + 0.35 * (fractal(p * 2.3) - 0.5)
    return grain * worn * (0.2 + 0.8 * edge(border - 0.006, 0.006))


def brick_wall(p: Array) -> Array:
    row, column, border = cells(p[0], p[1], 0.42, 0.14, 0.6)
    rough = fractal(p * 9)
    clay = ramp(0.75 * cell_random(row, column) + 0.5 * rough - 0.1, "5f3529", "94523a", "a96f53", "bd987b")
    lime = 0.8 * edge(fractal(p * 1.1 + 5) - 0.62, 0.15) * edge(fractal(p * 7, 2) - 0.4, 0.2)
    wall = mix(ramp(rough, "8a837b", "bdb6a9"), clay, edge(border + 0.02 * rough - 0.026, 0.008))
    return mix(wall, linear("d6cdbb"), lime)


def quilt(p: Array) -> Array:
    x, y, _ = p
    i, j = np.floor(x / 0.34), np.floor(y / 0.34)
    u, v = x / 0.34 - i, y / 0.34 - j
    kind = cell_random(i, j, i + 5)
    ground = ramp(np.floor(cell_random(i, j) * 6) / 5, "84302c", "d3c4a0", "304b60", "be8a40", "5b6947", "ddd1b8")
    figure = ramp(np.floor(cell_random(j, i) * 5) / 4, "e8dcc2", "44342e", "ad5a42", "7d929c", "d8b266")
    wobble = 0.12 * (noise(p * 14) - 0.5)
    stripes = np.sin((u + wobble) * 31.4)
    diagonal = np.sin((u + v + wobble) * 18.85)
    diamond = 9 * (0.33 - np.abs(u - 0.5 + wobble) - np.abs(v - 0.5))
    blossom = 9 * (fractal(np.stack([x * 17, y * 17, 9 * kind]), 2) - 0.54)
    pattern = np.select([kind < 0.2, kind < 0.4, kind < 0.6], [stripes, diagonal, diamond], blossom)
    seam = np.minimum(np.minimum(u, 1 - u), np.minimum(v, 1 - v))
    weave = 0.72 + 0.4 * noise(p * 75) + 0.3 * (fractal(p * 6, 2) - 0.5)
    return mix(ground, figure, edge(pattern, 0.5)) * weave * (0.55 + 0.45 * edge(seam - 0.035, 0.05))


def porcelain(p: Array) -> Array:
    """Cream glaze with blue arabesques between bands."""
    n = fractal(p * 5.5)
    paint = np.maximum(edge(n - 0.6, 0.03), 1 - edge(np.abs(n - 0.45) - 0.03, 0.02))
    band = np.abs((p[2] + 0.006 * noise(p * 20) + 0.02) % 0.26 - 0.13)
    paint = np.where(band < 0.022, edge(band - 0.008, 0.005), paint)
    return mix(ramp(fractal(p * 16 + 3), "cfc3a4", "efe6d0"), ramp(noise(p * 30), "1d3568", "3f66a8"), paint)


def globe(p: Array) -> Array:
    """Continents of an imaginary planet, and a graticule of 30 degrees."""
    p = p / np.linalg.norm(p, axis=0)
    height = fractal(p * 2.1 + 4, 5)
    sea = ramp(height * 1.9, "1f4e74", "2f7396", "7fb3b8")
    land = ramp((height - 0.52) * 3.2 + 0.4 * (noise(p * 12) - 0.5), "c9b36d", "6f8a46", "8a6a3f", "e2d5bd")
    latitude, longitude = np.degrees(np.arcsin(p[2].clip(-1, 1))), np.degrees(np.arctan2(p[1], p[0]))
    meridian = np.abs((longitude + 15) % 30 - 15) * np.hypot(p[0], p[1])
    line = np.minimum(np.abs((latitude + 15) % 30 - 15), meridian)
    coast = 1 - edge(np.abs(height - 0.52) - 0.012, 0.008)
    ink = (0.55 + 0.45 * edge(line - 0.7, 0.7)) * (1 - 0.6 * coast) * (0.85 + 0.3 * noise(p * 40))
    return mix(sea, land, edge(height - 0.52, 0.012)) * ink


def peel(*colours: str, streak: float = 0.0) -> Texture:
    """Skin of a fruit, mottled and porous. `streak` stretches the spots from pole to pole."""

    def texture(p: Array) -> Array:
        mottle = fractal(p * np.array([[14], [14], [14 * (1 - streak)]]) + int(colours[0], 16) % 31)
        return ramp(0.8 * mottle + 1.5 * streak * p[2] + 0.1, *colours) * (0.8 + 0.3 * noise(p * 95))

    return texture


def cover(colour: str, gilt: str) -> Texture:
    """Cloth of a book cover with a printed label in a gilt frame."""

    def texture(p: Array) -> Array:
        x, y, _ = p
        weave = 0.6 + 0.5 * noise(p * 90) + 0.5 * (fractal(p * 11) - 0.5)
        label = np.maximum(np.abs(x - 0.06) / 0.11, np.abs(y) / 0.08)
        print_ = (noise(np.stack([x * 30, y * 60, 0 * x])) > 0.6) & (label < 0.8)
        frame = (np.abs(label - 1.45) < 0.12) & (fractal(p * 40, 2) > 0.3)
        paper = mix(ramp(fractal(p * 25, 2), gilt, "efe6d2"), linear("3b2a22"), print_)
        return np.where(label < 1, paper, mix(linear(colour) * weave, linear(gilt), frame))

    return texture


def pages(p: Array) -> Array:
    x, y, z = p
    leaves = noise(np.stack([x * 6, y * 6, z * 170]))
    return ramp(0.7 * leaves + 0.3 * noise(p * 18), "a08e70", "eee3ca")


TOY = wood("8f6437", "dcb27c", 2.0)


def toy(paint: str, mark: str) -> Texture:
    """Paint of a wooden block whose faces are marked and slightly chipped."""

    def texture(p: Array) -> Array:
        inside = edge(0.085 - np.sort(np.abs(p), axis=0)[1], 0.006)
        whole = edge(fractal(p * 20) - 0.24, 0.05)
        face = mix(linear(paint), linear(mark), edge(noise(p * 13 + 40) - 0.55, 0.04))
        return mix(TOY(p), face * (0.8 + 0.3 * noise(p * 60)), inside * whole)

    return texture


def terracotta(p: Array) -> Array:
    turned = noise(p * np.array([[4], [4], [50]])) - 0.5
    clay = ramp(fractal(p * 12, 4) + 0.15 * turned, "7d3f28", "b5653f", "d08a5f")
    return mix(clay, linear("d8cbb8"), 0.55 * edge(fractal(p * 5 + 11, 4) - 0.62, 0.12))


OAK = wood("4d3320", "a67c4e", 1.3)


def barrel(p: Array) -> Array:
    turn = np.arctan2(p[1], p[0]) * 18 / (2 * np.pi)
    stave = np.floor(turn)
    oak = OAK(np.stack([p[2], np.hypot(p[0], p[1]) * 0.3 + turn * 0.14, cell_random(stave) * 2]))
    oak = oak * (0.7 + 0.5 * cell_random(stave)) * (1 - 0.7 * edge(np.abs(turn - stave - 0.5) - 0.46, 0.03))
    hoop = np.minimum(np.abs(np.abs(p[2]) - 0.17), np.abs(np.abs(p[2]) - 0.36))
    return mix(ramp(fractal(p * 18), "2a2624", "5b4a40", "8a5a3c"), oak, edge(hoop - 0.028, 0.006))


def trunk(p: Array) -> Array:
    row, column, border = cells(p[0] + p[1], p[2] + p[1] * 0.9, 3.0, 0.15, 1.0)
    board = OAK(p + 0.4 * row) * (0.6 + 0.5 * cell_random(row, column + 3))
    strap = np.abs(np.abs(p[0]) - 0.45)
    leather = ramp(fractal(p * 16), "2b1d16", "5a3a26")
    return mix(leather, board * (0.3 + 0.7 * edge(border - 0.008, 0.008)), edge(strap - 0.06, 0.008))


def book(
    centre: tuple[float, float, float], size: tuple[float, float, float], yaw: float, cloth: Texture
) -> list[Solid]:
    """Pages between two covers and a spine. `size` is half of the edges, m; `yaw` is in degrees."""
    x, y, z = size
    a = np.radians(yaw)
    across = np.array([-np.sin(a), np.cos(a), 0])
    up = np.array([0, 0, z - 0.006])
    return [
        Solid(Cube(), cloth, centre + up, (x, y, 0.006), yaw, texels=12),
        Solid(Cube(), cloth, centre - up, (x, y, 0.006), yaw, texels=12),
        Solid(Cube(), cloth, centre - (y - 0.008) * across, (x, 0.008, z), yaw, texels=12),
        Solid(Cube(), pages, centre, (x - 0.012, y - 0.012, z - 0.01), yaw, texels=12),
    ]


def pumpkin(x: float, y: float) -> list[Solid]:
    """A pumpkin of nine ribs and a stalk."""
    skin = peel("a9521c", "d07c2a", "e3a552", streak=0.7)
    stalk = Lathe((0, -1), (1, -1), (0.5, 0), (0.7, 1), (0, 1))
    solids = [Solid(stalk, wood("4b4a26", "8f8a4e", 3), (x, y, 0.42), (0.05, 0.05, 0.08), tilt=12)]
    for yaw in range(0, 360, 40):
        a = np.radians(yaw)
        centre = (x + 0.13 * np.cos(a), y + 0.13 * np.sin(a), 0.2)
        solids.append(Solid(Sphere(), skin, centre, (0.165, 0.1, 0.19), yaw, texels=12))
    return solids


def still_life() -> list[Solid]:
    """Objects on a quilt in a walled courtyard, unlit until `clsplat.demo.ray_tracer.bake`."""
    bowl = Lathe((0, 0), (0.16, 0), (0.17, 0.03), (0.3, 0.08), (0.4, 0.22), (0.385, 0.225), (0.28, 0.1), (0, 0.06))
    vase = Lathe(
        *((0, 0), (0.17, 0), (0.2, 0.06), (0.36, 0.4), (0.3, 0.68), (0.12, 0.8), (0.12, 0.94), (0.19, 1.0)),
        *((0.15, 1.0), (0.09, 0.9), (0.09, 0.6), (0, 0.6)),
    )
    pot = Lathe((0, 0), (0.2, 0), (0.3, 0.36), (0.34, 0.36), (0.34, 0.44), (0.3, 0.44), (0.28, 0.38), (0, 0.38))
    foot = Lathe((0, 0), (0.2, 0), (0.22, 0.03), (0.06, 0.07), (0.045, 0.16), (0.1, 0.2), (0, 0.2))
    cask = Lathe((0, -0.5), (0.32, -0.5), (0.43, 0), (0.32, 0.5), (0.3, 0.5), (0.3, 0.46), (0, 0.46))
    apple = peel("a8b04a", "c2502f", "8a2320", streak=0.75)
    orange = peel("c8691c", "e2932f", "e8ab50")
    solids = [
        Solid(Square(), floorboards, (0, 0, 0), 4.6, texels=120),
        Solid(Square(), quilt, (0.02, -0.02, 0.012), (1.62, 1.35, 1), yaw=12, texels=144),
        Solid(vase, porcelain, (-0.42, 0.42, 0.012), 1.05, texels=56),
        Solid(foot, wood("3d2416", "7d4c2a", 3), (0.62, 0.5, 0.012), 1),
        Solid(Sphere(), globe, (0.62, 0.5, 0.52), 0.32, yaw=20, tilt=23, texels=48),
        Solid(bowl, terracotta, (-0.05, -0.55, 0.012), 1.0, texels=56),
        Solid(Sphere(), orange, (-0.17, -0.62, 0.22), 0.115),
        Solid(Sphere(), orange, (0.06, -0.67, 0.225), 0.11, tilt=70),
        Solid(Sphere(), apple, (0.0, -0.43, 0.225), (0.12, 0.12, 0.105), tilt=15),
        Solid(Sphere(), peel("d3b535", "ecd667"), (-0.05, -0.57, 0.36), (0.13, 0.085, 0.085), yaw=35),
        Solid(Sphere(), apple, (0.74, -0.38, 0.353), (0.115, 0.115, 0.105), yaw=60, tilt=-20),
        Solid(Cube(), toy("b5402f", "ecd7a4"), (0.28, -1.0, 0.107), 0.095, yaw=25, texels=16),
        Solid(Cube(), toy("356f99", "e8bd58"), (0.02, -1.08, 0.107), 0.095, yaw=-12, texels=16),
        Solid(Cube(), toy("d6a238", "4a7650"), (0.16, -1.03, 0.297), 0.095, yaw=48, texels=16),
        Solid(pot, terracotta, (-2.9, 2.6, 0), 1.6),
        Solid(Sphere(), peel("2f4a22", "587437", "8c9e58"), (-2.9, 2.6, 1.05), (0.62, 0.62, 0.6)),
        Solid(cask, barrel, (2.9, 2.7, 0.5), 1.0, texels=40),
        Solid(Cube(), trunk, (3.2, -2.2, 0.35), (0.8, 0.45, 0.35), yaw=70, texels=16),
        *book((0.72, -0.38, 0.077), (0.34, 0.25, 0.065), -18, cover("31584b", "c2a552")),
        *book((0.7, -0.36, 0.195), (0.3, 0.22, 0.053), 189, cover("75302f", "d0ba88")),
        *pumpkin(-0.95, -0.22),
    ]
    for yaw in (0, 90, 180, 270):
        outward = np.array([-np.sin(np.radians(yaw)), np.cos(np.radians(yaw)), 0])
        solids.append(Solid(Square(), brick_wall, 4.4 * outward + [0, 0, 1.3], (4.4, 1.3, 1), yaw, 90, texels=40))
    return solids
