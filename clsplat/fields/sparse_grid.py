"""A sparse grid of densities and spherical harmonics: its cells, its rows of features, and how they are learned."""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.field_stages import NO_ROW, RayColors, Samples
from clsplat.stages import AdamStep

if TYPE_CHECKING:
    from clsplat.device import Device
    from clsplat.ops import Launches

Array = NDArray[Any]

BETA2, EPS = 0.95, 1e-8
"""Constants of RMSProp (code of Fridovich-Keil et al. 2022). It is Adam without a mean of the gradients."""

TV_SHARE = 100
"""Number of steps after which each corner has had the total variation in its gradient once (section 3.4)."""


class Seen(NamedTuple):
    """What rays see of a grid: the samples, the arguments of the stages heads and rays, and the colours."""

    samples: Samples
    head: tuple[Any, Any, Any, float]
    composited: tuple[Any, Any, Any, Any, Any]
    image: RayColors


class SparseGrid:
    """Cells of the unit cube, and features at the corners of those that are occupied.

    Parameters
    ----------
    stages : Launches
    device : Device
    occupied : (nz, ny, nx) uint8
    row : (F,)
        Features of all corners at the start.
    density_scale : float
        Density of a stored value of 1.
    closed : bool
        Whether the last corners along x are the first ones.

    Attributes
    ----------
    occupied : (nz, ny, nx) uint8
    cells
        The same on the device.
    table, squares : (M, F) real
        On the device: features, and running means of the squares of their gradients.
    """

    def __init__(
        self,
        stages: "Launches",
        device: "Device",
        occupied: NDArray[np.uint8],
        row: Array,
        density_scale: float,
        *,
        closed: bool = False,
    ):
        self._stages, self._device, self._closed, self.density_scale = stages, device, closed, density_scale
        rows = int(corners_of(occupied, closed=closed).sum())
        self.place(occupied, np.tile(row, (rows, 1)))

    def place(self, occupied: NDArray[np.uint8], table: Array) -> None:
        """Set the occupied cells and the rows of their corners, in the order of the corners."""
        known = corners_of(occupied, closed=self._closed)
        corners = np.flatnonzero(known).astype(np.uint32)
        index = np.full(known.shape, NO_ROW, np.uint32)
        index.reshape(-1)[corners] = np.arange(len(corners), dtype=np.uint32)
        if self._closed:
            index[..., -1] = index[..., 0]
        self.occupied, self._corners_host = occupied, corners
        upload = self._device.upload
        self.cells, self._index = upload("occupied", occupied, np.uint8), upload("index", index, np.uint32)
        self._corners = upload("corners", corners, np.uint32)
        self.table, self.squares = upload("table", table), upload("squares", np.zeros(table.shape))

    def see(self, samples: Samples, directions: Any, background: Any) -> Seen:
        """Colours of rays at samples, in front of a background (see `clsplat.ops.rays_fwd`)."""
        features = self._stages.voxels_fwd(samples.positions, self._index, self.table)
        head = features, directions, samples.rays_of, self.density_scale
        composited = *self._stages.heads_sh_fwd(*head), samples.deltas, samples.first, background
        return Seen(samples, head, composited, self._stages.rays_fwd(*composited))

    def gradient(self, seen: Seen, v_rgb: Any) -> Any:
        """Gradient with respect to the table, (M, F), from that of the colours (R, 3)."""
        v = self._stages.rays_bwd(*seen.composited, seen.image.transmittances, v_rgb)
        v_features = self._stages.heads_sh_bwd(*seen.head, *v)
        return self._stages.voxels_bwd(seen.samples.positions, self._index, self.table.shape[0], v_features)

    def descend(self, gradient: Any, variation: tuple[float, float], rate: float, number: int) -> None:
        """Take step `number` of RMSProp.

        Parameters
        ----------
        gradient : (M, F) real
            The total variation of a share of the corners is added to it.
        variation : two floats
            Weights of the total variation of the densities, and of that of the harmonics.
        rate : float
        number : int
        """
        rows = self.table.shape[0]
        count = -(-rows // TV_SHARE)
        weights = variation[0] * self.density_scale / count, variation[1] / count
        where = self._index, self._corners, self.table, gradient
        self._stages.voxels_tv(*where, weights, number * count % rows, count)
        step = AdamStep(number, {}, 0.0, BETA2, EPS, 0)
        # With beta1 = 0 the mean of the gradients is the gradient, which is where it is already.
        self._stages.adam_array(self.table, gradient, gradient, self.squares, rate, step, sparse=True)

    def prune(self, density: float) -> None:
        """Keep the cells with a corner above a density, and those around them."""
        from scipy.ndimage import maximum_filter

        corners, table = np.array(self.occupied.shape) + 1, self.table.get()
        dense = np.zeros(corners, bool)
        dense.reshape(-1)[self._corners_host] = self.density_scale * table[:, 0] > density
        if self._closed:
            dense[..., -1] = dense[..., 0]
        mode = ["constant", "constant", "wrap" if self._closed else "constant"]
        kept = maximum_filter(cells_of(dense), 3, mode=mode) & (self.occupied != 0)
        if not kept.any():  # a grid that is empty may still become dense
            return
        rows = corners_of(kept, closed=self._closed).reshape(-1)[self._corners_host]
        self.place(kept.astype(np.uint8), table[rows])

    def refine(self) -> None:
        """Divide each cell by two along each axis; new corners are interpolated."""
        occupied = self.occupied
        for axis in range(3):
            occupied = np.repeat(occupied, 2, axis=axis)
        places = np.argwhere(corners_of(occupied, closed=self._closed))[:, ::-1] / np.array(occupied.shape[::-1])
        positions = self._device.upload("positions", places)
        self.place(occupied, self._stages.voxels_fwd(positions, self._index, self.table).get())

    def model(self) -> dict[str, Array]:
        """The table, the numbers of cells, and the occupied ones."""
        cells = np.array(self.occupied.shape)
        return {"table": self.table.get(), "cells": cells, "occupied": np.packbits(self.occupied)}

    def restore(self, table: Array, cells: Array, occupied: Array) -> None:
        """Set the arrays of `model`.

        Raises
        ------
        ValueError
            If they do not belong together: kernels would read beyond the end of the table or of the cells.
        """
        grid = np.unpackbits(occupied)[: cells.prod()].reshape(cells)
        shape = int(corners_of(grid, closed=self._closed).sum()), self.table.shape[1]
        if table.shape != shape or np.ptp(cells / self.occupied.shape) > 0:  # all axes are divided as often
            raise ValueError(f"a table of shape {table.shape} for {shape[0]} corners of {cells} cells")
        self.place(grid, table)

    def round(self) -> None:
        """Round the table to half precision."""
        self.table.set(self.table.get().astype(np.float16).astype(self._device.real))


def corners_of(occupied: Array, *, closed: bool = False) -> NDArray[np.bool_]:
    """Corners (nz + 1, ny + 1, nx + 1) of the occupied cells (nz, ny, nx); of a closed grid, not those at its end."""
    nz, ny, nx = occupied.shape
    corners = np.zeros((nz + 1, ny + 1, nx + 1), bool)
    for k in range(8):
        z, y, x = k >> 2, k >> 1 & 1, k & 1
        corners[z : z + nz, y : y + ny, x : x + nx] |= occupied != 0
    if closed:
        corners[..., 0] |= corners[..., -1]
        corners[..., -1] = False
    return corners


def cells_of(corners: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cells (nz, ny, nx) with at least one of the corners (nz + 1, ny + 1, nx + 1)."""
    nz, ny, nx = np.array(corners.shape) - 1
    cells = np.zeros((nz, ny, nx), bool)
    for k in range(8):
        z, y, x = k >> 2, k >> 1 & 1, k & 1
        cells |= corners[z : z + nz, y : y + ny, x : x + nx]
    return cells
