"""Points that a transforms.json names."""

import numpy as np
import pytest
from numpy.lib.recfunctions import repack_fields
from test_transforms import write

from clsplat.config import DataConfig
from clsplat.dataset.transforms import read_dataset
from clsplat.errors import InputError


@pytest.mark.parametrize("binary", [True, False])
def test_points_come_from_the_ply(root, binary):
    from plyfile import PlyData, PlyElement

    dtype = [(axis, "f4") for axis in "xyz"] + [(channel, "u1") for channel in ("red", "green", "blue")]
    vertices = np.array([(1, 2, 3, 4, 5, 6), (-1, 0, 0.5, 255, 0, 7)], dtype=dtype)
    PlyData([PlyElement.describe(vertices, "vertex")], text=not binary).write(root / "points.ply")
    write(root, fl_x=50, ply_file_path="points.ply")
    dataset = read_dataset(root, DataConfig())
    np.testing.assert_array_equal(dataset.points, [[1, 2, 3], [-1, 0, 0.5]])
    np.testing.assert_array_equal(dataset.colors, [[4, 5, 6], [255, 0, 7]])
    PlyData([PlyElement.describe(repack_fields(vertices[["x", "y", "z"]]), "vertex")]).write(root / "points.ply")
    np.testing.assert_array_equal(read_dataset(root, DataConfig()).colors, np.full((2, 3), 128))
    PlyData([PlyElement.describe(vertices[:0], "vertex")], text=not binary).write(root / "points.ply")
    assert read_dataset(root, DataConfig()).points.shape == (0, 3), "points are then triangulated"
    vertices["x"] = np.nan
    PlyData([PlyElement.describe(vertices, "vertex")]).write(root / "points.ply")
    with pytest.raises(InputError, match=r"points\.ply.*finite"):
        read_dataset(root, DataConfig())


PLY_HEADER = b"ply\nformat %s 1.0\nelement vertex 1000000000000\nproperty float x\nend_header\n"


@pytest.mark.parametrize("content", [None, b"", PLY_HEADER % b"ascii", PLY_HEADER % b"binary_little_endian"])
def test_damaged_points_are_refused_by_name(root, content):
    if content is not None:
        (root / "points.ply").write_bytes(content)
    write(root, fl_x=50, ply_file_path="points.ply")
    with pytest.raises(InputError, match=r"points\.ply"):
        read_dataset(root, DataConfig())


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
def test_points_declared_but_not_there_take_no_memory(root, kind):
    header = f"ply\nformat {kind} 1.0\nelement vertex 100000000000\n" + "".join(
        f"property float {a}\n" for a in "xyz"
    )
    (root / "points.ply").write_text(f"{header}end_header\n1 2 3\n")
    write(root, fl_x=50, ply_file_path="points.ply")
    with pytest.raises(InputError, match=r"points\.ply: expected at least \d+ bytes"):
        read_dataset(root, DataConfig())
