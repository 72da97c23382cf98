"""Photos of all kinds of files: 16 bits, transparent, turned, damaged."""

from clsplat.bench.stability.images import ours, plain, right_kinds


def test_each_kind_is_read_right_or_refused_by_name():
    """A reader that converts whatever there is takes 16 bits for white, and forgets which way is up."""
    right, total = right_kinds(ours)
    assert right == total
    assert right_kinds(plain)[0] <= total - 5
