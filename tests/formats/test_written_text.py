"""The formats that are only written, .usda and .csv: their text, and OpenUSD's own reader."""

import csv
import re

import numpy as np
import pytest
from bounds import random_gaussians, save
from foreign_code import usd_attributes

from clsplat.errors import InputError
from clsplat.formats import WRITE_ONLY, load_gaussians, save_gaussians
from clsplat.formats.usda import ROWS

EACH = pytest.mark.parametrize("suffix", WRITE_ONLY)


def numbers(text):
    return np.array(re.findall(r"-?\d[\d.e+-]*", text), np.float64)


def stage(path):
    """The arrays of a .usda by name."""
    found = re.findall(r"^    (?:uniform )?[a-z0-9]+(?:\[\])? ([\w:]+) = (.*)$", path.read_text(), flags=re.M)
    return {name: numbers(text) for name, text in found}


@pytest.mark.parametrize("degree", [0, 3])
def test_a_stage(tmp_path, degree):
    g = random_gaussians(9, degree)
    assert not save(tmp_path / "a.usda", g)
    found = stage(tmp_path / "a.usda")
    # Right, up, back: y and z have the opposite sign.
    np.testing.assert_array_equal(np.float32(found["positions"]).reshape(9, 3), g.means * np.float32([1, -1, -1]))
    np.testing.assert_array_equal(
        np.float32(found["orientations"]).reshape(9, 4), g.quats * np.float32([1, 1, -1, -1])
    )
    np.testing.assert_allclose(found["scales"].reshape(9, 3), g.scales, rtol=1e-6)
    np.testing.assert_allclose(found["opacities"], g.opacities, rtol=1e-6)
    assert found["radiance:sphericalHarmonicsDegree"] == degree
    sh = found["radiance:sphericalHarmonicsCoefficients"].reshape(9, -1, 3)
    np.testing.assert_array_equal(np.float32(sh[:, 0]), g.sh[:, 0])
    np.testing.assert_array_equal(np.abs(np.float32(sh)), np.abs(g.sh))
    low, high = found["extent"].reshape(2, 3)
    points = found["positions"].reshape(9, 3)
    assert (low < points).all() and (points < high).all()


def test_a_table(tmp_path):
    g = random_gaussians(9, 1)
    assert not save(tmp_path / "a.csv", g)
    with open(tmp_path / "a.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    table = {name: np.array([row[name] for row in rows], np.float32) for name in rows[0]}
    save_gaussians(tmp_path / "a.ply", g)
    from plyfile import PlyData

    vertices = PlyData.read(tmp_path / "a.ply")["vertex"]
    expected = [prop.name for prop in vertices.properties if prop.name not in ("nx", "ny", "nz")]
    assert list(table) == expected
    for name in expected:
        np.testing.assert_array_equal(table[name], vertices[name])


@EACH
def test_what_is_lost_is_said(tmp_path, suffix):
    said = save(tmp_path / f"a{suffix}", random_gaussians(3), "antialiased", [5, 0, 0])
    assert "mode of the scene, antialiased" in said and "no place for the world offset [5.0, 0.0, 0.0]" in said


@EACH
def test_bytes_repeat_and_failures_leave_nothing(tmp_path, suffix):
    for name in ("a", "b"):
        save(tmp_path / f"{name}{suffix}", random_gaussians(7))
    assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()
    gaussians = random_gaussians(7)
    gaussians.means[2, 1] = np.nan
    with pytest.raises(InputError, match="in Gaussian 2"):
        save_gaussians(tmp_path / f"c{suffix}", gaussians)
    with pytest.raises(InputError, match="at least one"):
        save_gaussians(tmp_path / f"c{suffix}", random_gaussians(0))
    with pytest.raises(InputError, match="No such file"):
        save_gaussians(tmp_path / "no folder" / f"c{suffix}", random_gaussians(2))
    assert len(list(tmp_path.iterdir())) == 2


@EACH
def test_clsplat_does_not_read_it(tmp_path, suffix):
    with pytest.raises(InputError, match=f"found {suffix}, which it only writes"):
        load_gaussians(tmp_path / f"a{suffix}")


def test_many_rows_are_written_in_parts(tmp_path):
    g = random_gaussians(ROWS + 3, 0)
    save(tmp_path / "a.usda", g)
    np.testing.assert_allclose(stage(tmp_path / "a.usda")["opacities"], g.opacities, rtol=1e-6)


def test_a_scale_beyond_float32(tmp_path):
    gaussians = random_gaussians(2)
    gaussians.log_scales[0] = 95
    with pytest.raises(InputError, match="scales that float32 can hold"):
        save_gaussians(tmp_path / "a.usda", gaussians)


@pytest.mark.foreign
@pytest.mark.parametrize("degree", [0, 2])
def test_openusd_reads_the_stage(tmp_path, degree):
    g = random_gaussians(50, degree)
    save(tmp_path / "a.usda", g)
    found = usd_attributes(tmp_path / "a.usda")
    assert found["unknown"] == [] and found["up"] == "Y"
    np.testing.assert_array_equal(np.float32(found["positions"]), g.means * np.float32([1, -1, -1]))
    np.testing.assert_array_equal(np.float32(found["orientations"]), g.quats * np.float32([1, 1, -1, -1]))
    np.testing.assert_allclose(found["scales"], g.scales, rtol=1e-6)
    np.testing.assert_allclose(found["opacities"], g.opacities, rtol=1e-6)
    assert found["radiance:sphericalHarmonicsDegree"] == degree
    assert len(found["radiance:sphericalHarmonicsCoefficients"]) == 50 * (degree + 1) ** 2
