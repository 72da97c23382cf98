"""Launch of the stage composite (cl/composite_cpu.cl, cl/composite_gpu.cl, cl/composite_sorted.cl)."""

from typing import Any

import numpy as np

from clsplat.constants import SEGMENT
from clsplat.device import Device
from clsplat.errors import DeviceError
from clsplat.ops.bin import check_slots
from clsplat.stages import AnyGrads, AnySplats, Bins, Image, RayGrads, RaySplats, SplatGrads

# Number of splats that the GPU variant's forward pass loads at a time, and per batch of its backward pass without
# subgroups, where each is a work-item. GPUs without subgroups run 32 work-items in lockstep (measured: docs/gpu.md).
GPU_STAGED, GPU_BATCH = 64, 32

# Number of splats that a pixel composites in one round if pixels are sorted. It changes the speed, not the image.
WINDOW = 32

# Largest number of work-items that a compute unit of a GPU keeps at a time. Drivers reserve private memory for all.
RESIDENT = 2048


def check_private(device: Device, tile_size: int, channels: int) -> None:
    """Raise a DeviceError if a GPU has no memory for the windows of sorted pixels, which are private memory."""
    values = tile_size**2 * (3 * WINDOW + channels + 4)  # cl/composite_sorted.cl: Pixels
    reserved = values * device.real.itemsize * device.cl_device.max_compute_units * RESIDENT
    left = device.memory_limit - device.memory
    if not device.is_cpu and reserved > left:
        raise DeviceError(
            f"--sort pixel: {device.label} would reserve {reserved / 2**30:.1f} GiB for windows of sorted pixels, "
            f"but {left / 2**30:.1f} GiB are left; use --sort global or a CPU"
        )


def gpu_batch(device: Device) -> int:
    """Number of splats per batch of the GPU variant: the work-items of a subgroup, if there are subgroups."""
    return device.group(device.subgroup_size or GPU_BATCH)


def variant(device: Device, compositor: str = "auto", disparities: Any = None) -> str:
    """Name of the kernel variant, composite_cpu, composite_gpu or composite_sorted."""
    if disparities is not None:
        return "composite_sorted"
    if compositor == "auto":
        compositor = "cpu" if device.is_cpu else "gpu"
    return f"composite_{compositor}"


def ray_charts(splats: AnySplats) -> int:
    """Value of -DRAYS (cl/composite_cpu.cl): 0, or 1 and 2 for splats along rays in the image or in own charts."""
    if not isinstance(splats, RaySplats):
        return 0
    return 1 if splats.rays.shape[1] == 8 else 2


def directions_of(splats: AnySplats) -> list[Any]:
    """The last argument of kernels that composite along rays in charts of the splats."""
    return [splats.directions] if isinstance(splats, RaySplats) and ray_charts(splats) == 2 else []


def lanes_of(device: Device, bins: Bins) -> int:
    """Value of -DLANES (cl/composite_blocks.h): a tile has 64 blocks at most."""
    return max(device.vector_width, bins.tile_size**2 // 64)


def _defines(device: Device, bins: Bins, channels: int, stage: str, rays: int = 0) -> dict[str, Any]:
    lanes = lanes_of(device, bins)
    own: dict[str, dict[str, int]] = {
        "composite_cpu": {"LANES": lanes},
        "composite_gpu": {
            "ITEMS": device.group(bins.tile_size**2),
            "STAGED": GPU_STAGED,
            "BATCH": gpu_batch(device),
            "SEGMENT": SEGMENT,
            "SUBGROUPS": int(device.subgroup_size > 0),
        },
        "composite_sorted": {"LANES": lanes, "WINDOW": WINDOW},
    }
    along = {} if stage == "composite_sorted" else {"RAYS": rays}
    return {"TILE": bins.tile_size, "CHANNELS": channels} | own[stage] | along


HEADS = (8, 16, 23)
"""Numbers of a packed splat besides its colours, by the value of -DRAYS (cl/composite.h, cl/composite_rays.h)."""


def packed(device: Device, splats: AnySplats, bins: Bins, stage: str) -> Any:
    """Splats in the layout that the kernels read: SPLAT_REALS each (cl/composite.h)."""
    (n, channels), rays = splats.colors.shape, ray_charts(splats)
    result = device.empty("packed splats", (n, -(-(HEADS[rays] + channels) // 4) * 4))
    arguments = [n, splats.means2d, splats.conics, splats.extents, splats.opacities, splats.colors]
    if isinstance(splats, RaySplats):
        arguments.append(splats.rays)
    defines = _defines(device, bins, channels, stage, rays)
    device.launch(stage, "composite_pack", (n,), [*arguments, result], defines=defines)
    if bins.slots is not None:
        device.keep("packed splats", splats, result)  # for the backward pass
    return result


def _launch(
    device: Device,
    stage: str,
    kernel: str,
    bins: Bins,
    splats: AnySplats,
    arguments: list[Any],
    groups: int = 0,
    **changes: Any,
) -> None:
    """Queue a kernel, on GPUs over `groups` work-groups; by default over one, or one work-item, per tile."""
    groups = groups or bins.tile_ranges.shape[0]
    group = 1
    if stage == "composite_gpu":
        group = device.group(bins.tile_size**2) if kernel == "composite_fwd" else gpu_batch(device)
    arguments = [bins.width, bins.height, arguments[0], bins.gauss_ids, bins.tile_ranges, *arguments[1:]]
    arguments += directions_of(splats)
    defines = _defines(device, bins, splats.colors.shape[1], stage, ray_charts(splats)) | changes
    device.launch(stage, kernel, (groups * group,), arguments, defines=defines, group=(group,))


STATES = ("states", "reached")
"""Names of what the GPU variant's forward pass saves for its backward pass (cl/composite_gpu.cl)."""


def _listed(splats: AnySplats, bins: Bins) -> tuple[Any, ...]:
    """The arrays on which `STATES` depend."""
    return *splats, bins.gauss_ids, bins.tile_ranges


def _saved(device: Device, splats: AnySplats, bins: Bins) -> list[Any]:
    """Last arguments of the GPU variant's forward pass: whether it saves, and the arrays that it saves to."""
    tiles, saves = bins.tile_ranges.shape[0], bins.slots is not None
    states = bins.gauss_ids.shape[0] // SEGMENT if saves else 0
    shape = (max(1, states), 1 + splats.colors.shape[1], bins.tile_size**2 if states else 1)
    arrays = [device.empty(STATES[0], shape), device.empty(STATES[1], tiles, np.uint32)]
    for name, array in zip(STATES, arrays, strict=True):
        if saves:
            device.keep(name, _listed(splats, bins), array)
    return [int(saves), *arrays]


def composite_until(device: Device, splats: AnySplats, pack: Any, bins: Bins, background: Any, stop: float) -> Any:
    """Image (H, W, C) by the GPU variant, whose pixels stop at another transmittance than TRANSMITTANCE_MIN."""
    channels = len(background)
    result = device.empty("image", (bins.height, bins.width, channels))
    alpha = device.empty("alpha", (bins.height, bins.width))
    arguments = [pack, device.constant("background", background), result, alpha, *_saved(device, splats, bins)]
    _launch(device, "composite_gpu", "composite_fwd", bins, splats, arguments, TRANSMITTANCE_MIN=stop)
    return result


def composite_fwd(
    device: Device,
    splats: AnySplats,
    bins: Bins,
    background: Any,
    *,
    compositor: str = "auto",
    disparities: Any = None,
) -> Image:
    """Composite splats front to back.

    Parameters
    ----------
    splats : Splats or RaySplats with C colour channels
    bins : Bins of the same splats
    background : (C,) array on the host
    compositor : {"auto", "cpu", "gpu"}
        Kernel variant, if pixels use the order of `bins`.
    disparities : (N, 3), optional
        Result of `project_disparities`. If given, each pixel sorts its splats by disparity, nearest first. The order
        of `bins` decides ties.
    """
    channels = splats.colors.shape[1]
    result = Image(
        device.empty("image", (bins.height, bins.width, channels)),
        device.empty("alpha", (bins.height, bins.width)),
    )
    stage = variant(device, compositor, disparities)
    if stage == "composite_sorted":
        check_private(device, bins.tile_size, channels)
    arguments = [packed(device, splats, bins, stage), device.constant("background", background), *result]
    arguments += [] if disparities is None else [disparities]
    if stage == "composite_gpu":
        arguments += _saved(device, splats, bins)
    _launch(device, stage, "composite_fwd", bins, splats, arguments)
    return result


def composite_bwd(
    device: Device,
    splats: AnySplats,
    bins: Bins,
    image: Image,
    v_image: Image,
    *,
    compositor: str = "auto",
    disparities: Any = None,
) -> AnyGrads:
    """Gradients with respect to the splats.

    Parameters
    ----------
    splats, bins, compositor, disparities
        As given to `composite_fwd`. The splats must not have changed since.
    image : Image
        Its result.
    v_image : Image
        Gradients with respect to the image and to alpha.

    Raises
    ------
    InputError
        If the lists were made without gradients.
    """
    check_slots(bins)
    n, channels = splats.colors.shape
    m = bins.gauss_ids.shape[0]
    moments = 10 if isinstance(splats, RaySplats) else 6
    records = device.empty("gradients per intersection", (max(m, 1), moments + channels))
    stage = variant(device, compositor, disparities)
    pack = device.kept("packed splats", splats)
    if pack is None:
        pack = packed(device, splats, bins, stage)
    arguments, groups = [pack, bins.slots, *image, *v_image], bins.tile_ranges.shape[0]
    if stage == "composite_gpu":
        owner = _listed(splats, bins)
        if device.kept(STATES[0], owner) is None:  # another image has been composited since
            composite_fwd(device, splats, bins, np.zeros(channels), compositor="gpu")
        arguments += [device.kept(name, owner) for name in STATES]
        groups += m // SEGMENT
    arguments += [records] if disparities is None else [records, disparities]
    _launch(device, stage, "composite_bwd", bins, splats, arguments, groups=groups)
    geometry = device.empty("v_means2d", (n, 2)), device.empty("v_conics", (n, 3))
    rest = device.empty("v_opacities", n), device.empty("v_colors", (n, channels))
    v: AnyGrads = SplatGrads(*geometry, *rest)
    conics = splats.conics
    if isinstance(splats, RaySplats):
        v, conics = RayGrads(*geometry, device.empty("v_slopes", (n, 3)), *rest), splats.rays
    arguments = [n, bins.first_slots, conics, splats.opacities, records, *v]
    defines = _defines(device, bins, channels, stage, ray_charts(splats))
    device.launch(stage, "composite_sum", (n,), arguments, defines=defines)
    return v
