"""Image files of many kinds: 16 bits, transparent, rotated, damaged."""

from clsplat.bench.stability.images import ours, plain, right_kinds


def test_each_kind_is_read_correctly_or_refused_by_name():
    """A reader that only converts to RGB reads 16 bits as white, and ignores the orientation."""
    right, total = right_kinds(ours)
    assert right == total
    assert right_kinds(plain)[0] <= total - 5
