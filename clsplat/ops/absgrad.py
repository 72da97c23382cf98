"""Launch of the stage absgrad (cl/absgrad.cl)."""

from typing import Any

from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.ops.composite import gpu_batch, packed, variant
from clsplat.stages import AnySplats, Bins, Image, Splats


def absgrad(device: Device, splats: AnySplats, bins: Bins, image: Image, v_image: Image) -> Any:
    """Sums over pixels of the absolute gradients with respect to the splats' centres.

    Parameters
    ----------
    splats : Splats with C colour channels
        Those of the affine projection.
    bins : Bins of the same splats
        Made with gradients.
    image : Image
        Result of `composite_fwd`.
    v_image : Image
        Gradients with respect to the image and to alpha.

    Returns
    -------
    (N, 2)
        px^-1; at least the absolute values of `means2d` of `composite_bwd`; 0 for what is not visible.

    Raises
    ------
    InputError
        If the lists were made without gradients, or the splats are those along rays.
    """
    if bins.slots is None or not isinstance(splats, Splats):
        raise InputError(
            "splats, bins: expected those of the affine projection, and lists made with gradients=True, found others"
        )
    (n, channels), tiles, m = splats.colors.shape, bins.tile_ranges.shape[0], bins.gauss_ids.shape[0]
    group = 1 if device.is_cpu else gpu_batch(device)
    subgroups = int(device.subgroup_size > 0 and not device.is_cpu)
    defines = {"TILE": bins.tile_size, "CHANNELS": channels, "RAYS": 0, "BATCH": group, "SUBGROUPS": subgroups}
    records = device.empty("absolute gradients per intersection", (max(m, 1), 2))
    pack = packed(device, splats, bins, variant(device))
    lists = [bins.gauss_ids, bins.tile_ranges, bins.slots]
    arguments = [bins.width, bins.height, pack, *lists, *image, *v_image, records]
    device.launch("absgrad", "absgrad_tiles", (tiles * group,), arguments, defines=defines, group=(group,))
    sums = device.empty("absgrad", (n, 2))
    arguments = [n, bins.first_slots, records, sums]
    device.launch("absgrad", "absgrad_sum", (n,), arguments, defines=defines)
    return sums
