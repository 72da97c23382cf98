"""Minutes of training under a viewer whose clients come and go; `make soak` takes hours."""

import sys

import pytest

pytest.importorskip("viser", reason="viser, the extra `viewer`, is missing")

from measure_soak import check, soak


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the memory of a process is read from Linux's /proc")
def test_memory_does_not_grow_and_bits_stay(tmp_path):
    check(soak(3, tmp_path))
    assert (tmp_path / "soak.png").stat().st_size > 0
