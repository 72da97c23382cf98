"""Radiance fields to compare with Gaussians: the methods of `METHODS`, trained and rendered on the same device.

Belongs here: one module per method, and what they share: their space, pixels, grid of occupied cells, training and
files. Does not belong here: kernels and launches, which are stages, and anything of Gaussians.
"""

from clsplat.fields.field import Field
from clsplat.fields.ingp import IngpBase, IngpBig
from clsplat.fields.mipnerf360 import MipNerf360, MipNerf360Small
from clsplat.fields.nerf import Nerf, NerfSmall
from clsplat.fields.plenoxels import Plenoxels

METHODS: dict[str, type[Field]] = {
    method.name: method for method in (Nerf, NerfSmall, Plenoxels, IngpBase, IngpBig, MipNerf360, MipNerf360Small)
}
"""Methods by the name that `--method` takes."""

GAUSSIANS = "gaussians"
"""Name that stands for no field: the Gaussians that clsplat trains by default."""


def method_names() -> list[str]:
    """Names that `--method` takes."""
    return [GAUSSIANS, *METHODS]
