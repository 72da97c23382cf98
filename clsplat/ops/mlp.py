"""Launches of the stage mlp (cl/mlp_cpu.cl, cl/mlp_gpu.cl)."""

from itertools import accumulate, pairwise
from typing import Any

from pyopencl.array import Array

from clsplat.device import Device
from clsplat.errors import InputError

# As in cl/mlp_cpu.cl: rows that pass through all layers together.
CHUNK = 96

# As in cl/mlp_gpu.cl: largest edge of a work-group, and rows of a tile of the results.
TILE, HEIGHT = 16, 64

# Number of slabs of rows on a GPU, each with its own sum of the gradient of the weights.
SLABS = 32

WIDTH_MAX = 2048
"""Largest width of a layer: that of Mip-NeRF 360 whose inputs are 1024 features and an encoding of 512 has 1536."""


def mlp_fwd(device: Device, inputs: Array, weights: Array, widths: tuple[int, ...]) -> tuple[Array, Array]:
    """Apply a network of fully connected layers, without offsets: max(x W, 0), and x W in the last layer.

    Parameters
    ----------
    inputs : (S, widths[0]) real
    weights : (P,) real
        The matrices (widths[l], widths[l + 1]) of all layers, one after the other.
    widths : tuple of int
        Of the inputs and of each layer's results: multiples of 16, at most `WIDTH_MAX`.

    Returns
    -------
    outputs : (S, widths[-1]) real
    hidden : (S (widths[1] + ... + widths[-2]),) real
        Results (S, widths[l]) of all layers but the last, one after the other, for `mlp_bwd`.

    Raises
    ------
    InputError
        If a width is not a multiple of 16 or is too large.
    """
    rows = inputs.shape[0]
    _check(widths)
    outputs = device.empty("outputs", (rows, widths[-1]))
    hidden = device.empty("hidden", max(1, rows * sum(widths[1:-1])))
    if device.is_cpu:
        # Four bands per core, in whole chunks.
        bands = min(-(-rows // CHUNK), 4 * device.cl_device.max_compute_units)
        band = -(-rows // (bands * CHUNK)) * CHUNK
        arguments = [rows, band, inputs, weights, hidden, outputs]
        size = (-(-rows // band),)
        device.launch("mlp_cpu", "mlp_fwd", size, arguments, defines=_defines(device, widths), group=(1,))
        return outputs, hidden
    firsts = list(accumulate(widths[1:-1], initial=0))  # of each layer's results in `hidden`
    place = 0
    for layer, (width, after) in enumerate(pairwise(widths)):
        first, last = layer == 0, layer == len(widths) - 2
        x, x_first = (inputs, 0) if first else (hidden, firsts[layer - 1])
        y, y_first = (outputs, 0) if last else (hidden, firsts[layer])
        scalars = [rows, width, after, 0, int(not last), 0, x_first, place, y_first, 0]
        _product(device, rows, after, [*scalars, x, weights, x, y])
        place += width * after
    return outputs, hidden


def mlp_bwd(
    device: Device,
    inputs: Array,
    weights: Array,
    widths: tuple[int, ...],
    hidden: Array,
    v_outputs: Array,
    columns: int,
    v_weights: Array | None = None,
) -> tuple[Array, Array]:
    """Gradients of `mlp_fwd`. They repeat to the bit.

    Parameters
    ----------
    inputs, weights, widths
        As given to `mlp_fwd`.
    hidden
        As returned by it.
    v_outputs : (S, widths[-1]) real
    columns : int
        Number of the first inputs whose gradient is computed: 0 to widths[0], a multiple of 16.
    v_weights : (P,) real, optional
        A gradient to which that of the weights is added, in place.

    Returns
    -------
    v_inputs : (S, columns) real
        One number where there are no columns.
    v_weights : (P,) real
    """
    rows, count, added = inputs.shape[0], weights.size, int(v_weights is not None)
    v_inputs = device.empty("v_inputs", (rows, columns) if columns else 1)
    v_weights = device.empty("v_weights", count) if v_weights is None else v_weights
    if device.is_cpu:
        defines = _defines(device, widths)
        items = min(-(-rows // CHUNK), 2 * device.cl_device.max_compute_units)
        turned = device.empty("turned weights", count)
        work, parts = device.empty("work", items * 2 * CHUNK * max(widths)), device.empty("parts", items * count)
        device.launch("mlp_cpu", "mlp_turn", (1,), [weights, turned], defines=defines, group=(1,))
        scalars = [rows, items, count, sum(widths[1:-1]), columns]
        arguments = [*scalars, inputs, turned, hidden, v_outputs, work, v_inputs, parts]
        device.launch("mlp_cpu", "mlp_bwd", (items,), arguments, defines=defines, group=(1,))
        device.launch("mlp_cpu", "mlp_sum", (count,), [count, items, added, parts, v_weights], defines=defines)
        return v_inputs, v_weights
    slab = -(-rows // (SLABS * TILE)) * TILE
    slabs = -(-rows // slab)
    parts, work = device.empty("parts", slabs * count), device.empty("work", 2 * rows * max(widths))
    firsts = list(accumulate(widths[1:-1], initial=0))
    place, v, v_first = count, v_outputs, 0
    for layer in reversed(range(len(widths) - 1)):
        width, after = widths[layer], widths[layer + 1]
        place -= width * after
        x, x_first = (hidden, firsts[layer - 1]) if layer else (inputs, 0)
        scalars = [rows, slab, width, after, count, place, x_first, v_first]
        size = after, width, slabs
        tile = _tile(device)
        arguments = [*scalars, x, v, parts]
        device.launch("mlp_gpu", "mlp_columns", size, arguments, defines={"TILE": tile}, group=(tile, tile, 1))
        y, y_first = (work, max(widths) * (layer % 2)) if layer else (v_inputs, 0)
        needed = width if layer else columns
        if needed:
            scalars = [rows, after, needed, 1, 0, int(layer > 0), v_first, place, y_first, x_first]
            _product(device, rows, needed, [*scalars, v, weights, x, y])
        v, v_first = y, y_first
    arguments = [count, slabs, added, parts, v_weights]
    device.launch("mlp_gpu", "mlp_sum", (count,), arguments, defines={"TILE": _tile(device)})
    return v_inputs, v_weights


def _tile(device: Device) -> int:
    """Edge of the work-groups: `TILE`, or less where the device does not run groups of that size."""
    tile = TILE
    while tile**2 > device.largest_group:
        tile //= 2
    return tile


def _product(device: Device, rows: int, columns: int, arguments: list[Any]) -> None:
    tile = _tile(device)
    size = columns, -(-rows // HEIGHT) * tile
    device.launch("mlp_gpu", "mlp_product", size, arguments, defines={"TILE": tile}, group=(tile, tile))


def _check(widths: tuple[int, ...]) -> None:
    if len(widths) < 2 or any(width % 16 or not 0 < width <= WIDTH_MAX for width in widths):
        raise InputError(f"widths: expected two or more multiples of 16 up to {WIDTH_MAX}, found {widths}")


def _defines(device: Device, widths: tuple[int, ...]) -> dict[str, Any]:
    rows = 12 if device.vector_width == 16 else 6
    return {"WIDTHS": ",".join(map(str, widths)), "WIDEST": max(widths), "ROWS": rows}
