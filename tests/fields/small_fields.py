"""Fields of few parameters and short steps, for tests."""

from clsplat.fields.ingp import IngpBase
from clsplat.fields.plenoxels import Plenoxels


class SmallIngp(IngpBase):
    """Instant-NGP with small tables and steps."""

    entries, cells, samples = 2**12, 32, 2**13


class SmallPlenoxels(Plenoxels):
    """Plenoxels of few cells and short steps."""

    cells, samples = 8, 2**13
