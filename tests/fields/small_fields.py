"""Fields of few parameters and short steps, for tests."""

import pytest

from clsplat.config import BACKGROUNDS, DataConfig, TrainConfig
from clsplat.fields.ingp import IngpBase
from clsplat.fields.mipnerf360 import MipNerf360Small
from clsplat.fields.nerf import NerfSmall
from clsplat.fields.plenoxels import Plenoxels


class SmallIngp(IngpBase):
    """Instant-NGP with small tables and steps."""

    entries, cells, samples = 2**12, 32, 2**13


class SmallPlenoxels(Plenoxels):
    """Plenoxels of few cells and short steps."""

    cells, samples = 8, 2**13


class SmallNerf(NerfSmall):
    """NeRF with small networks and few samples."""

    width, coarse, fine, rays = 32, 16, 16, 128
    rate = 8e-3


class SmallMipNerf360(MipNerf360Small):
    """Mip-NeRF 360 with small networks and few samples."""

    width, features, color_width, proposal_width, levels = 32, 32, 16, 16, 4
    proposals, samples, rays = 16, 12, 128
    rate = 1e-2


WHITE = BACKGROUNDS["white"]
CONFIG = TrainConfig(iterations=250, data=DataConfig(background="white"))

SMALL = [SmallIngp, SmallPlenoxels, SmallNerf, SmallMipNerf360]
EACH = pytest.mark.parametrize("method", SMALL, ids=lambda m: m.name)

CASES = [*((method, False) for method in SMALL), (SmallPlenoxels, True)]
ALL = pytest.mark.parametrize(("method", "room"), CASES, ids=lambda v: v.name if isinstance(v, type) else f"room={v}")
"""All methods without a background, and the one with it whose model then has other arrays."""
