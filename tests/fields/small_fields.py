"""Fields of few parameters and short steps, for tests."""

from clsplat.fields.ingp import IngpBase


class SmallIngp(IngpBase):
    """Instant-NGP with small tables and steps."""

    entries, cells, samples = 2**12, 32, 2**13
