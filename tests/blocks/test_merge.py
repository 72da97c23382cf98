"""The merge of blocks: the bytes of the whole scene, in memory that does not grow with it."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from clsplat.blocks.whole import merge
from clsplat.errors import InputError
from clsplat.formats import load_gaussians, save_gaussians
from clsplat.formats.ply import with_coefficients
from clsplat.gaussians import Gaussians
from clsplat.testing import synthetic_scene

OFFSET = np.array([1e6, 0.5, -2.0])

ROWS = 500
"""Rows in memory at a time."""


def written(folder: Path, degrees: list[int], count: int) -> list[Path]:
    """PLYs of some degrees of spherical harmonics."""
    files = []
    for k, degree in enumerate(degrees):
        gaussians = synthetic_scene(count, seed=k)[0]
        part = Gaussians(**gaussians.arrays() | {"sh": gaussians.sh[:, : (degree + 1) ** 2]})
        files.append(folder / f"{k}.ply")
        save_gaussians(files[-1], part, "antialiased")
    return files


@pytest.fixture(autouse=True)
def small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("clsplat.formats.ply_parts.CHUNK", ROWS)


def test_the_merge_has_the_bytes_of_the_whole_scene(tmp_path: Path) -> None:
    files = written(tmp_path, [1, 2, 0], 3 * ROWS - 7)
    parts = [with_coefficients(load_gaussians(file)[0], 9) for file in files]
    save_gaussians(tmp_path / "expected.ply", Gaussians.concatenate(parts), "antialiased", OFFSET)
    assert merge(files, tmp_path / "scene.ply", OFFSET) == 3 * (3 * ROWS - 7)
    assert (tmp_path / "scene.ply").read_bytes() == (tmp_path / "expected.ply").read_bytes()


def test_the_memory_does_not_grow_with_the_scene(tmp_path: Path) -> None:
    files = written(tmp_path, [2] * 8, 4 * ROWS)
    peaks = []
    for count in (2, 2, 8):  # the first one imports modules
        tracemalloc.start()
        merge(files[:count], tmp_path / "scene.ply")
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    whole = 8 * 4 * ROWS * 4 * (14 + 3 * 9)  # bytes of float32
    # The headers of six more files take some kilobytes each.
    assert peaks[2] < peaks[1] + 0.1 * whole and peaks[2] < 0.6 * whole


def test_a_damaged_result_leaves_the_earlier_scene(tmp_path: Path) -> None:
    files = written(tmp_path, [1, 1], 2 * ROWS)
    (tmp_path / "scene.ply").write_bytes(b"earlier")
    content = bytearray(files[1].read_bytes())
    content[-4:] = np.float32(np.nan).tobytes()
    files[1].write_bytes(content)
    with pytest.raises(InputError, match=r"1\.ply: expected finite values"):
        merge(files, tmp_path / "scene.ply")
    assert (tmp_path / "scene.ply").read_bytes() == b"earlier"
    assert {path.suffix for path in tmp_path.iterdir()} == {".ply"}
