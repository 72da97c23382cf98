"""Twin of the stage composite: one splat after the other over the pixels of a tile.

Kerbl et al. 2023, equations 3 and 4. The cost of a splat is that of the box of its extents, outside which
alpha < ALPHA_MIN: with one tile as large as the image (`clsplat.render`) nothing but that box is left of tiling.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.constants import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from clsplat.stages import Bins, Image, SplatGrads, Splats

Array = NDArray[np.float64]


class Hit(NamedTuple):
    """One splat over the box of its extents within a tile; arrays of the box's shape (h, w)."""

    splat: int
    box: tuple[slice, slice]
    dx: Array
    dy: Array
    alpha: Array  # not clamped, 0 where the splat is not drawn
    before: Array  # transmittance in front of the splat
    live: NDArray[np.bool_]  # where no splat in front has finished the pixel


def hits(
    splats: Splats, bins: Bins, transmittance: Array, transmittance_min: float = TRANSMITTANCE_MIN
) -> Iterator[Hit]:
    """Yield hits tile by tile, front to back; `transmittance` (H, W) is brought from 1 to its end."""
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
            a, b, c = splats.conics[g]
            sigma = 0.5 * (a * dx**2 + c * dy**2) + b * dx * dy
            alpha = splats.opacities[g] * np.exp(-sigma)
            before, was_live = transmittance[box].copy(), live[box].copy()
            behind = before * (1 - np.minimum(alpha, ALPHA_MAX))
            reached = was_live & (alpha >= ALPHA_MIN) & (sigma >= 0)
            drawn = reached & (behind > transmittance_min)
            live[box] &= ~reached | drawn
            transmittance[box] = np.where(drawn, behind, before)
            yield Hit(int(g), box, dx, dy, np.where(drawn, alpha, 0), before, was_live)


def composite_fwd(splats: Splats, bins: Bins, background: Any, *, compositor: str = "auto") -> Image:
    """Composite splats front to back; arguments and result as `clsplat.ops.composite_fwd`."""
    transmittance = np.empty((bins.height, bins.width))
    image = np.zeros((bins.height, bins.width, splats.colors.shape[1]))
    for hit in hits(splats, bins, transmittance):
        weight = np.minimum(hit.alpha, ALPHA_MAX) * hit.before
        image[hit.box] += weight[:, :, None] * splats.colors[hit.splat]
    return Image(image + transmittance[:, :, None] * np.asarray(background, dtype=np.float64), 1 - transmittance)


def composite_bwd(
    splats: Splats, bins: Bins, image: Image, v_image: Image, *, compositor: str = "auto"
) -> SplatGrads:
    """Gradients of `composite_fwd`; arguments and result as `clsplat.ops.composite_bwd`.

    With u = colour . v_image and `behind` the sum of u alpha T over the splats behind, the background and alpha's own
    term included, v_alpha = T u - behind/(1 - alpha).
    """
    v = SplatGrads(*(np.zeros_like(a) for a in (splats.means2d, splats.conics, splats.opacities, splats.colors)))
    transmittance = np.empty((bins.height, bins.width))
    behind = (image.image * v_image.image).sum(axis=2) - (1 - image.alpha) * v_image.alpha
    for hit in hits(splats, bins, transmittance):
        g, dx, dy = hit.splat, hit.dx, hit.dy
        clamped = np.minimum(hit.alpha, ALPHA_MAX)
        weight = clamped * hit.before
        u = v_image.image[hit.box] @ splats.colors[g]
        behind[hit.box] -= weight * u
        v_alpha = hit.before * u - behind[hit.box] / (1 - clamped)
        v_sigma = np.where(hit.alpha < ALPHA_MAX, -hit.alpha * v_alpha, 0)
        a, b, c = splats.conics[g]
        v.means2d[g] -= [(v_sigma * (a * dx + b * dy)).sum(), (v_sigma * (b * dx + c * dy)).sum()]
        v.conics[g] += [
            0.5 * (v_sigma * dx**2).sum(),
            (v_sigma * dx * dy).sum(),
            0.5 * (v_sigma * dy**2).sum(),
        ]
        v.opacities[g] -= v_sigma.sum() / splats.opacities[g]
        v.colors[g] += np.einsum("hw,hwc->c", weight, v_image.image[hit.box])
    return v
