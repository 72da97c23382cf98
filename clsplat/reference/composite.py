"""Twin of the stage composite: composites one splat after the other over the pixels of a tile.

Kerbl et al. 2023, equations 3 and 4. A splat is evaluated in the box of its extents, outside which alpha < ALPHA_MIN.
The renderer (`clsplat.render`) uses a single tile of the size of the image, so that tiling has no effect.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.constants import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from clsplat.reference.gaussian_rays import chart_offsets, ray_exponents, ray_exponents_bwd
from clsplat.stages import AnyGrads, AnySplats, Bins, Image, RayGrads, RaySplats, SplatGrads

Array = NDArray[np.float64]


class Hit(NamedTuple):
    """One splat over the box of its extents within a tile. Arrays have the shape of the box, (h, w)."""

    splat: int
    box: tuple[slice, slice]
    dx: Array
    dy: Array
    alpha: Array  # not clamped; 0 where the splat is not drawn
    before: Array  # transmittance in front of the splat
    live: NDArray[np.bool_]  # True where compositing has not stopped before this splat
    bend: Any  # along rays: the offsets in the chart, and the factors r and h; otherwise None


class Layer(NamedTuple):
    """One splat in each of P different pixels. Arrays have the shape (P,)."""

    pixels: tuple[NDArray[np.intp], NDArray[np.intp]]  # rows, columns
    splats: NDArray[np.intp]
    dx: Array
    dy: Array
    alpha: Array  # as in Hit
    before: Array


def hits(
    splats: AnySplats, bins: Bins, transmittance: Array, transmittance_min: float = TRANSMITTANCE_MIN
) -> Iterator[Hit]:
    """Yield hits tile by tile, front to back. `transmittance` (H, W) is set to 1 and updated to its final value."""
    transmittance[:] = 1
    live = np.ones(transmittance.shape, dtype=bool)
    tiles_x = -(-bins.width // bins.tile_size)
    for t, (begin, end) in enumerate(bins.tile_ranges):
        origin = np.array([t % tiles_x, t // tiles_x]) * bins.tile_size
        stop = np.minimum(origin + bins.tile_size, [bins.width, bins.height])
        for g in bins.gauss_ids[begin:end]:
            centre, extent = splats.means2d[g], splats.extents[g]
            x0, y0 = np.maximum(origin, np.ceil(centre - extent - 0.5)).astype(int)
            x1, y1 = np.minimum(stop, np.floor(centre + extent - 0.5) + 1).astype(int)
            if x0 >= x1 or y0 >= y1:
                continue
            box = (slice(y0, y1), slice(x0, x1))
            dx = np.arange(x0, x1)[None, :] + 0.5 - centre[0]
            dy = np.arange(y0, y1)[:, None] + 0.5 - centre[1]
            bend = None
            if isinstance(splats, RaySplats):
                columns, rows = np.arange(x0, x1)[None, :], np.arange(y0, y1)[:, None]
                offsets = chart_offsets(splats.rays[g], splats.directions, columns, rows)
                sigma, ratio, share = ray_exponents(splats.rays[g], offsets)
                bend = offsets, (ratio, share)
            else:
                a, b, c = splats.conics[g]
                sigma = 0.5 * (a * dx**2 + c * dy**2) + b * dx * dy
            alpha = splats.opacities[g] * np.exp(-sigma)
            before, was_live = transmittance[box].copy(), live[box].copy()
            behind = before * (1 - np.minimum(alpha, ALPHA_MAX))
            reached = was_live & (alpha >= ALPHA_MIN) & (sigma >= 0)
            drawn = reached & (behind > transmittance_min)
            live[box] &= ~reached | drawn
            transmittance[box] = np.where(drawn, behind, before)
            yield Hit(int(g), box, dx, dy, np.where(drawn, alpha, 0), before, was_live, bend)


def layers(splats: AnySplats, bins: Bins, disparities: Array, transmittance: Array) -> Iterator[Layer]:
    """Yield the splats of all pixels by disparity: first the nearest of each pixel, then the second, and so on.

    `transmittance` is updated as in `hits`.
    """
    found = [np.zeros((7, 0))]
    for hit in hits(splats, bins, transmittance, transmittance_min=-1.0):  # all splats: no pixel stops
        y, x = np.nonzero(hit.alpha)
        dx, dy = hit.dx[0, x], hit.dy[y, 0]
        disparity = disparities[hit.splat] @ [np.ones(len(x)), dx, dy]
        rows, columns = y + hit.box[0].start, x + hit.box[1].start
        found.append(np.stack([rows, columns, np.full(len(x), hit.splat), disparity, dx, dy, hit.alpha[y, x]]))
    pairs = np.concatenate(found, axis=1)
    pairs = pairs[:, np.lexsort((-pairs[3], pairs[1], pairs[0]))]  # stable: ties keep the order of the lists
    pixel = pairs[0] * bins.width + pairs[1]
    rank = np.arange(len(pixel)) - np.searchsorted(pixel, pixel)
    transmittance[:] = 1
    live = np.ones(transmittance.shape, dtype=bool)
    for r in range(int(rank.max(initial=-1)) + 1):
        rows, columns, splat = pairs[:3, rank == r].astype(int)
        dx, dy, alpha = pairs[4:, rank == r]
        pixels = rows, columns
        before = transmittance[pixels]
        behind = before * (1 - np.minimum(alpha, ALPHA_MAX))
        live[pixels] &= behind > TRANSMITTANCE_MIN
        transmittance[pixels] = np.where(live[pixels], behind, before)
        yield Layer(pixels, splat, dx, dy, np.where(live[pixels], alpha, 0), before)


def composite_fwd(
    splats: AnySplats, bins: Bins, background: Any, *, compositor: str = "auto", disparities: Any = None
) -> Image:
    """Composite splats front to back. Arguments and result as for `clsplat.ops.composite_fwd`."""
    transmittance = np.empty((bins.height, bins.width))
    image = np.zeros((bins.height, bins.width, splats.colors.shape[1]))
    if disparities is None:
        for hit in hits(splats, bins, transmittance):
            weight = np.minimum(hit.alpha, ALPHA_MAX) * hit.before
            image[hit.box] += weight[:, :, None] * splats.colors[hit.splat]
    else:
        for layer in layers(splats, bins, disparities, transmittance):
            weight = np.minimum(layer.alpha, ALPHA_MAX) * layer.before
            image[layer.pixels] += weight[:, None] * splats.colors[layer.splats]
    return Image(image + transmittance[:, :, None] * np.asarray(background, dtype=np.float64), 1 - transmittance)


def composite_bwd(
    splats: AnySplats,
    bins: Bins,
    image: Image,
    v_image: Image,
    *,
    compositor: str = "auto",
    disparities: Any = None,
) -> AnyGrads:
    """Gradients of `composite_fwd`. Arguments and result as for `clsplat.ops.composite_bwd`."""
    shapes = {"slopes": splats.conics}
    fields = RayGrads._fields if isinstance(splats, RaySplats) else SplatGrads._fields
    found = {name: np.zeros_like(shapes[name] if name in shapes else getattr(splats, name)) for name in fields}
    v: Any = RayGrads(**found) if isinstance(splats, RaySplats) else SplatGrads(**found)
    transmittance = np.empty((bins.height, bins.width))
    behind = (image.rgb * v_image.rgb).sum(axis=2) - (1 - image.alpha) * v_image.alpha
    if disparities is None:
        for hit in hits(splats, bins, transmittance):
            g, dx, dy, v_pixels = hit.splat, hit.dx, hit.dy, v_image.rgb[hit.box]
            u = v_pixels @ splats.colors[g]
            v_sigma, weight, behind[hit.box] = gradient_of_sigma(hit.alpha, hit.before, u, behind[hit.box])
            if isinstance(splats, RaySplats):
                offsets, factors = hit.bend
                parts = ray_exponents_bwd(splats.rays[g], offsets, factors, v_sigma)
                for array, part in zip((v.means2d, v.conics, v.slopes), parts, strict=True):
                    array[g] += part
            else:
                a, b, c = splats.conics[g]
                v.means2d[g] -= [(v_sigma * (a * dx + b * dy)).sum(), (v_sigma * (b * dx + c * dy)).sum()]
                v.conics[g] += [(v_sigma * square).sum() for square in (0.5 * dx**2, dx * dy, 0.5 * dy**2)]
            v.opacities[g] -= v_sigma.sum() / splats.opacities[g]
            v.colors[g] += np.einsum("hw,hwc->c", weight, v_pixels)
    else:
        for layer in layers(splats, bins, disparities, transmittance):
            many, dx, dy, v_pixels = layer.splats, layer.dx, layer.dy, v_image.rgb[layer.pixels]
            u = (v_pixels * splats.colors[many]).sum(axis=1)
            v_sigma, weight, behind[layer.pixels] = gradient_of_sigma(
                layer.alpha, layer.before, u, behind[layer.pixels]
            )
            a, b, c = splats.conics[many].T
            np.subtract.at(v.means2d, many, (v_sigma * [a * dx + b * dy, b * dx + c * dy]).T)
            np.add.at(v.conics, many, (v_sigma * [0.5 * dx**2, dx * dy, 0.5 * dy**2]).T)
            np.subtract.at(v.opacities, many, v_sigma / splats.opacities[many])
            np.add.at(v.colors, many, weight[:, None] * v_pixels)
    # Gradients that overflow are set to 0: they would stay in the statistics of densification.
    finite = np.all([np.isfinite(a.reshape(len(a), -1)).all(axis=1) for a in v], axis=0)
    for gradients in v:
        gradients[~finite] = 0
    return v


def gradient_of_sigma(alpha: Array, before: Array, u: Array, behind: Array) -> tuple[Array, Array, Array]:
    """Gradient of sigma, the weight, and `behind` without the term of this splat.

    With u = colour . v_image, v_alpha = T u - behind/(1 - alpha). `behind` is the sum of u alpha T over the splats
    behind, plus the terms of the background and of the gradient with respect to alpha.
    """
    clamped = np.minimum(alpha, ALPHA_MAX)
    weight = clamped * before
    behind = behind - weight * u
    v_alpha = before * u - behind / (1 - clamped)
    return np.where(alpha < ALPHA_MAX, -alpha * v_alpha, 0), weight, behind
