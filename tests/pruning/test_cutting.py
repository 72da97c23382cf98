"""Cuts of a scene on the disk: the leaves of the cuts in memory, in bounded memory, with nothing left behind."""

import tracemalloc

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.formats import load_gaussians, save_gaussians
from clsplat.formats.ply import save_ply_parts
from clsplat.formats.ply_parts import PlyParts
from clsplat.pruning import cutting, levels
from clsplat.pruning.cutting import cut_on_disk, leaves
from clsplat.pruning.levels import detail_tree, detail_tree_of_file
from clsplat.testing import synthetic_scene


def equal(one, other):
    return all(
        a.tobytes() == b.tobytes() for a, b in zip(one.arrays().values(), other.arrays().values(), strict=True)
    )


@pytest.fixture
def scene(tmp_path):
    """Gaussians of which many have equal coordinates and zeros of both signs, in a PLY."""
    gaussians = synthetic_scene(3000, seed=1, sh_degree=1)[0].astype(np.float32)
    gaussians.means[::2] = np.round(gaussians.means[::2], 1)
    gaussians.means[::7, 0], gaussians.means[1::7, 0] = -0.0, 0.0
    save_gaussians(tmp_path / "scene.ply", gaussians)
    return load_gaussians(tmp_path / "scene.ply")[0]


@pytest.mark.parametrize("depth", [0, 1, 2, 4])
def test_leaves_are_those_of_cuts_in_memory(scene, tmp_path, monkeypatch, depth):
    monkeypatch.setattr("clsplat.formats.ply_parts.CHUNK", 257)
    monkeypatch.setattr(cutting, "CHUNK", 101)
    found = list(cut_on_disk(PlyParts(tmp_path / "scene.ply"), tmp_path, depth))
    expected = list(leaves(scene, depth))
    assert len(found) == len(expected) == 2**depth
    assert all(equal(one, other) for one, other in zip(found, expected, strict=True))
    assert [path.name for path in tmp_path.iterdir()] == ["scene.ply"]


def test_rows_with_a_property_of_another_type_are_cut(tmp_path):
    names = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()
    rows = np.zeros(64, [*((name, "<f4") for name in names), ("label", "u1")])
    for name, values in zip(names, np.random.default_rng(0).normal(size=(14, 64)), strict=True):
        rows[name] = values
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 64\n"
    header += "".join(f"property float {name}\n" for name in names) + "property uchar label\nend_header\n"
    (tmp_path / "scene.ply").write_bytes(header.encode() + rows.tobytes())
    found = cut_on_disk(PlyParts(tmp_path / "scene.ply"), tmp_path, 1)
    expected = leaves(load_gaussians(tmp_path / "scene.ply")[0], 1)
    assert all(equal(one, other) for one, other in zip(found, expected, strict=True))


def test_levels_of_a_file_are_those_of_the_scene(scene, tmp_path):
    found = list(detail_tree_of_file(PlyParts(tmp_path / "scene.ply"), tmp_path, leaf=100))
    expected = list(detail_tree(scene, leaf=100))
    assert 100 * levels.HELD < len(scene), "the scene is cut on the disk"
    for one, other in zip(found, expected, strict=True):
        assert one[:2] == other[:2] and one.leaves == other.leaves and equal(one.gaussians, other.gaussians)


def test_memory_grows_with_the_parts_and_not_with_the_scene(tmp_path, monkeypatch):
    monkeypatch.setattr("clsplat.formats.ply_parts.CHUNK", 1 << 10)
    monkeypatch.setattr(cutting, "CHUNK", 1 << 10)
    peaks = []
    for depth in (2, 5):
        gaussians = synthetic_scene(1000 << depth, seed=2, sh_degree=3)[0].astype(np.float32)
        save_gaussians(tmp_path / "scene.ply", gaussians)
        del gaussians
        rows = PlyParts(tmp_path / "scene.ply")
        tracemalloc.start()
        for _ in cut_on_disk(rows, tmp_path, depth):
            pass
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    # Eight times the scene, which itself takes 1 and 8 MB. What grows is a mask per cut and chunk.
    assert peaks[1] < 1.2 * peaks[0]


def test_values_that_are_not_finite_are_found_before_anything_is_cut(scene, tmp_path, monkeypatch):
    monkeypatch.setattr("clsplat.formats.ply_parts.CHUNK", 1000)
    data = bytearray((tmp_path / "scene.ply").read_bytes())
    rows = PlyParts(tmp_path / "scene.ply")
    at = len(data) - (3000 - 1234) * rows.dtype.itemsize
    data[at : at + 4] = np.float32(np.nan).tobytes()
    (tmp_path / "scene.ply").write_bytes(data)
    with pytest.raises(InputError, match="found x = nan in Gaussian 1234"):
        list(cut_on_disk(rows, tmp_path, 2))


def test_a_folder_that_cannot_be_written_is_named(scene, tmp_path):
    with pytest.raises(InputError, match=r"cannot write to .*missing"):
        list(cut_on_disk(PlyParts(tmp_path / "scene.ply"), tmp_path / "missing", 1))


def test_parts_are_written_to_the_bytes_of_the_whole(scene, tmp_path):
    save_gaussians(tmp_path / "whole.ply", scene, "antialiased", [1.0, 2.0, 3.0])
    parts = (scene.take(np.arange(first, first + 1000)) for first in (0, 1000, 2000))
    save_ply_parts(tmp_path / "parts.ply", parts, 3000, scene.sh.shape[1], "antialiased", [1.0, 2.0, 3.0])
    assert (tmp_path / "parts.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()
    rows = PlyParts(tmp_path / "parts.ply")
    assert rows.mode == "antialiased" and rows.offset.tolist() == [1, 2, 3] and rows.binary
