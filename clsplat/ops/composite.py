"""Launch of the stage composite (cl/composite_cpu.cl, cl/composite_gpu.cl)."""

from typing import Any

from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.stages import Bins, Image, SplatGrads, Splats

# Work-items of the GPU variant's backward kernel, one splat each: two or four subgroups on the GPUs known.
GPU_BATCH = 64


def variant(device: Device, compositor: str = "auto") -> str:
    """The stage of the kernels' variant."""
    if compositor == "auto":
        compositor = "cpu" if device.is_cpu else "gpu"
    return f"composite_{compositor}"


def _defines(bins: Bins, channels: int, stage: str) -> dict[str, Any]:
    batch = {"BATCH": GPU_BATCH} if stage == "composite_gpu" else {}
    return {"TILE": bins.tile_size, "CHANNELS": channels} | batch


def packed(device: Device, splats: Splats, bins: Bins, stage: str) -> Any:
    """The splats as the kernels read them: SPLAT_REALS each (cl/composite.h)."""
    n, channels = splats.colors.shape
    result = device.empty("packed splats", (n, -(-(6 + channels) // 4) * 4))
    geometry = [splats.means2d, splats.conics, splats.extents, splats.opacities, splats.colors]
    device.launch(stage, "composite_pack", (n,), [n, *geometry, result], defines=_defines(bins, channels, stage))
    return result


def _launch(device: Device, stage: str, kernel: str, bins: Bins, channels: int, arguments: list[Any]) -> None:
    tiles = bins.tile_ranges.shape[0]
    group = 1
    if stage == "composite_gpu":
        group = bins.tile_size**2 if kernel == "composite_fwd" else GPU_BATCH
    arguments = [bins.width, bins.height, arguments[0], bins.gauss_ids, bins.tile_ranges, *arguments[1:]]
    device.launch(stage, kernel, (tiles * group,), arguments, defines=_defines(bins, channels, stage), group=(group,))


def composite_fwd(device: Device, splats: Splats, bins: Bins, background: Any, *, compositor: str = "auto") -> Image:
    """Composite splats front to back.

    Parameters
    ----------
    splats : Splats with C colour channels
    bins : Bins of the same splats
    background : (C,) array on the host
    compositor : {"auto", "cpu", "gpu"}
        Kernel variant.
    """
    channels = splats.colors.shape[1]
    result = Image(
        device.empty("image", (bins.height, bins.width, channels)),
        device.empty("alpha", (bins.height, bins.width)),
    )
    stage = variant(device, compositor)
    arguments = [packed(device, splats, bins, stage), device.constant("background", background), *result]
    _launch(device, stage, "composite_fwd", bins, channels, arguments)
    return result


def composite_bwd(
    device: Device, splats: Splats, bins: Bins, image: Image, v_image: Image, *, compositor: str = "auto"
) -> SplatGrads:
    """Gradients with respect to the splats.

    Parameters
    ----------
    splats, bins, compositor
        As given to `composite_fwd`.
    image : Image
        Its result.
    v_image : Image
        Gradients with respect to the image and to alpha.

    Raises
    ------
    InputError
        If the lists were made without what gradients need.
    """
    if bins.slots is None:
        raise InputError(
            "bins: expected lists made with gradients=True, found lists without slots; bin the splats anew"
        )
    n, channels = splats.colors.shape
    m = bins.gauss_ids.shape[0]
    records = device.empty("gradients per intersection", (max(m, 1), 6 + channels))
    stage = variant(device, compositor)
    arguments = [packed(device, splats, bins, stage), bins.slots, *image, *v_image, records]
    _launch(device, stage, "composite_bwd", bins, channels, arguments)
    v = SplatGrads(
        device.empty("v_means2d", (n, 2)),
        device.empty("v_conics", (n, 3)),
        device.empty("v_opacities", n),
        device.empty("v_colors", (n, channels)),
    )
    arguments = [n, bins.order, bins.first_slots, splats.conics, splats.opacities, records, *v]
    device.launch(stage, "composite_sum", (n,), arguments, defines=_defines(bins, channels, stage))
    return v
