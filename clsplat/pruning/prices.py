"""Prices of Gaussians and of the bands of their spherical harmonics: their part in the error of rendered views.

The growth of the error when a single Gaussian is removed is known exactly (docs/stages/removal.md). When many are
removed together, some would have hidden the gaps that others leave. Gaussians are therefore removed in rounds, and
the remaining ones are priced again after each. Where the image is too bright, each Gaussian that contributes promises
a gain that only the first removal brings; an order by the error alone would remove them all. The price is therefore
at least the difference that a removal makes to the image, and more where that difference adds to an existing error.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.constants import ALPHA_MIN
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.renderer import Pass, Renderer, along_rays, download
from clsplat.scene import View, in_turn
from clsplat.stages import Removal

Array = NDArray[np.float64]

ROUND = 0.85
"""Fraction of the Gaussians that a round of `removal_order` leaves (measured: docs/howto/compact.md)."""


class Prices(NamedTuple):
    """Prices of N Gaussians: changes of the sum over the views of the mean squared error per pixel.

    errors (N,): change if the Gaussian alone is removed; negative if the error falls. differences (N,): the same with
    the render itself as the target. weights (N,): sums of the weight alpha T per pixel, 0 for a Gaussian that no view
    shows. squares (N,): the same of the squared weight. sights (N, 3): sums of the squared weight times the direction
    from the camera; grains (N,): sums of the squared weight times the squared size of a pixel at the Gaussian, world
    units. bands (N, D): column d, change if the Gaussian alone keeps the bands 0 to d of its spherical harmonics,
    whose degree is D.
    """

    errors: Array
    differences: Array
    weights: Array
    squares: Array
    sights: Array
    grains: Array
    bands: Array

    @property
    def costs(self) -> Array:
        """Prices by which Gaussians are pruned, (N,): the larger of errors and differences."""
        return np.maximum(self.errors, self.differences)


class Measured(NamedTuple):
    """Removal of each Gaussian measured in one view.

    sums: those of the stage removal, where the stages run. The rows of the backdrop, if there is one, follow those of
    the Gaussians.
    """

    view: View
    run: Pass
    sums: Any

    @property
    def pixels(self) -> int:
        """Number of pixels that count; 1 if there is none."""
        mask = self.view.mask
        return self.view.image[:, :, 0].size if mask is None else max(1, int(mask.sum()))

    @property
    def removal(self) -> Removal:
        """The sums of the Gaussians on the host."""
        return Removal.of(download(self.sums)[: len(self.run.gaussians)])


def measure_removals(
    renderer: Renderer,
    gaussians: Gaussians,
    views: Iterable[View],
    sh_degree: int | None = None,
    *,
    clamped: bool = False,
) -> Iterator[Measured]:
    """Render views and measure the removal of each Gaussian in each of them (stage removal).

    Parameters
    ----------
    renderer : Renderer
    gaussians : Gaussians of N >= 1 rows
        On the host or on the renderer's device.
    views : iterable of View
        Pixels that their masks leave out do not count.
    sh_degree : int, optional
        Highest degree of the spherical harmonics evaluated; default: all that are stored.
    clamped : bool
        Clamp the render to [0, 1] as a screen does: values above white are then no error.

    Yields
    ------
    Measured
        Per view. Callers delete it before they ask for the next one, which would otherwise take as much memory again.
    """
    placed = renderer.place(gaussians)
    for view in in_turn(views):
        yield _measured(renderer, placed, view, sh_degree, clamped)


def _measured(renderer: Renderer, placed: Gaussians, view: View, sh_degree: int | None, clamped: bool) -> Measured:
    run = renderer.forward(placed, view.camera, sh_degree)
    photo = renderer.upload("photo", view.image, np.uint8)
    mask = None if view.mask is None else renderer.upload("mask", view.mask, np.uint8)
    residuals = renderer.stages.removal_residuals(run.image.rgb, photo, clamped=clamped)
    background = np.array(renderer.background)
    sums = renderer.stages.removal_sums(run.drawn, run.bins, background, residuals, mask)
    return Measured(view, run, sums)


def price(gaussians: Gaussians, views: list[View], renderer: Renderer, *, bands: bool = True) -> Prices:
    """Price Gaussians by views.

    Parameters
    ----------
    gaussians : Gaussians
        At least one, on the host.
    views : list of View
        Photos, or renders of the scene before any was removed; pixels that their masks leave out do not count.
    renderer : Renderer
    bands : bool
        Whether the bands of the spherical harmonics are priced; otherwise their prices are 0.

    Returns
    -------
    Prices

    Raises
    ------
    InputError
        If there is no view or no Gaussian.
    """
    _demand(gaussians, views)
    n, degree = len(gaussians), gaussians.sh_degree
    total = Prices(
        np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n), np.zeros((n, 3)), np.zeros(n), np.zeros((n, degree))
    )
    for measured in measure_removals(renderer, gaussians, views, clamped=True):
        view, run, part, pixels = measured.view, measured.run, measured.removal, measured.pixels
        total.errors[:] += part.errors / pixels
        total.differences[:] += part.differences / pixels
        total.weights[:] += part.weights / pixels
        squares = part.squares / pixels
        direction, size = sight(gaussians, view.camera)
        total.squares[:] += squares
        total.sights[:] += squares[:, None] * direction
        total.grains[:] += squares * size**2
        if degree and bands:
            seen = np.flatnonzero(part.weights > 0)
            change = _color_changes(renderer, run)[seen]
            squares, pulls = part.squares[seen, None], part.pulls[seen]
            error = squares * (change**2).sum(axis=2) + 2 * np.einsum("ndc,nc->nd", change, pulls)
            total.bands[seen] += error / pixels
        del measured, run
    return total


def _demand(gaussians: Gaussians, views: list[View]) -> None:
    if not views or not len(gaussians):
        raise InputError(f"views, gaussians: expected at least one each, found {len(views)} and {len(gaussians)}")


def sight(gaussians: Gaussians, camera: Camera) -> tuple[Array, Array]:
    """Unit vectors (N, 3) along which a camera sees Gaussians, and the sizes (N,) of a pixel there, world units."""
    if camera.model == "orthographic":
        return np.tile(camera.viewmat[2, :3], (len(gaussians), 1)), np.full(len(gaussians), 1 / camera.fx)
    offsets = gaussians.means - camera.position
    distances = np.maximum(np.linalg.norm(offsets, axis=1), 1e-12)
    return offsets / distances[:, None], distances / camera.fx


def _color_changes(renderer: Renderer, run: Pass) -> Array:
    """Changes (N, D, 3) of the colours in a view if the bands above d = 0 to D - 1 are dropped."""
    antialiased = renderer.config.mode == "antialiased"
    colors = download(run.splats.colors)
    rays = along_rays(renderer.config, run.camera)
    fewer = [
        renderer.stages.project_fwd(run.gaussians, run.camera, degree, antialiased=antialiased, rays=rays).colors
        for degree in range(run.sh_degree)
    ]
    return np.stack([download(other) - colors for other in fewer], axis=1)


def _costs(gaussians: Gaussians, views: list[View], renderer: Renderer) -> Array:
    """`Prices.costs` times a number that all Gaussians share; added up where the stages run."""
    _demand(gaussians, views)
    names = "errors", "differences"
    sums = {name: renderer.zeros(f"sums of {name}", (len(gaussians), 2)) for name in names}
    pixels = 0
    for measured in measure_removals(renderer, gaussians, views, clamped=True):
        pixels = pixels or measured.pixels  # of the first photo: the factor is exactly 1 where all have as many
        for name in names:
            column = Removal._fields.index(name)
            renderer.stages.add_column(measured.sums, column, sums[name], pixels / measured.pixels)
        del measured
    errors, differences = (download(sums[name]).astype(np.float64).sum(axis=1) for name in names)
    return np.maximum(errors, differences)


def removal_order(
    gaussians: Gaussians,
    views: list[View],
    until: Callable[[Gaussians], bool],
    renderer: Renderer,
) -> NDArray[np.intp]:
    """Order Gaussians from the one to keep longest to the first one to remove.

    Parameters
    ----------
    gaussians, views, renderer
        As given to `price`.
    until : callable
        Called with the remaining Gaussians after each round; true ends the rounds. Those that remain then are ordered
        by their prices of the last round.

    Returns
    -------
    (N,) int
        Rows: ``gaussians.take(order[:n])`` is the scene pruned to n. Ties are ordered by index; the same input gives
        the same order.

    Raises
    ------
    InputError
        If there is no view or no Gaussian.
    """
    kept = np.arange(len(gaussians))
    gone: list[NDArray[np.intp]] = []
    while True:
        kept = kept[np.argsort(-_costs(gaussians.take(kept), views, renderer), kind="stable")]
        left = int(ROUND * len(kept))
        if left == 0 or until(gaussians.take(np.sort(kept[:left]))):
            return np.concatenate([kept, *reversed(gone)])
        gone.append(kept[left:])
        kept = np.sort(kept[:left])


def without_invisible(gaussians: Gaussians) -> Gaussians:
    """Remove Gaussians whose opacity is below ALPHA_MIN, which no pixel of any view shows; at least one remains."""
    shown = gaussians.opacities >= ALPHA_MIN
    shown[np.argmax(gaussians.logit_opacities)] = True
    return gaussians.take(shown)


def shown_by_any(gaussians: Gaussians, cameras: Iterable[Camera], renderer: Renderer) -> NDArray[np.bool_]:
    """Whether the image of any camera may show each Gaussian, (N,): its extents are above 0."""
    placed, shown = renderer.place(gaussians), np.zeros(len(gaussians), bool)
    for camera in cameras:
        shown |= download(renderer.project(placed, camera, 0).extents)[:, 0] > 0
    return shown


def with_degree(gaussians: Gaussians, degree: int) -> Gaussians:
    """Keep the bands 0 to `degree` of the spherical harmonics, at most those that are stored."""
    return replace(gaussians, sh=gaussians.sh[:, : (degree + 1) ** 2])


def without_bands(gaussians: Gaussians, bands: Array, budget: float) -> Gaussians:
    """Zero the bands above some degree of each Gaussian, the cheapest first, within a budget.

    Parameters
    ----------
    gaussians : Gaussians
    bands : (N, D)
        Prices of the bands, from `price` of the same Gaussians.
    budget : float
        Largest sum of the prices of the bands that are dropped.

    Returns
    -------
    Gaussians
        Gaussians of the same degree; formats that compress store the zeros in few bytes.
    """
    # The lowest degree first: dropping all bands of a Gaussian saves most.
    sh = gaussians.sh.copy()
    left, open_ = budget, np.ones(len(gaussians), dtype=bool)
    for degree in range(gaussians.sh_degree):
        candidates = np.flatnonzero(open_)
        candidates = candidates[np.argsort(bands[candidates, degree], kind="stable")]
        share = left / (gaussians.sh_degree - degree)
        sums = np.cumsum(np.maximum(bands[candidates, degree], 0))
        chosen = candidates[: int(np.searchsorted(sums, share, side="right"))]
        sh[chosen, (degree + 1) ** 2 :] = 0
        open_[chosen] = False
        left -= float(sums[len(chosen) - 1]) if len(chosen) else 0.0
    return replace(gaussians, sh=sh)
