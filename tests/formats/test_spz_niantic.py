"""SPZ files between clsplat and the library of Niantic."""

import numpy as np
import pytest
from bounds import BOUNDS, assert_within, random_gaussians
from foreign_code import read_spz, write_spz

from clsplat.formats.spz import load_spz, save_spz


@pytest.mark.foreign
@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize("axes", ["rub", "rdf"])
def test_the_library_of_niantic_reads_what_we_write(tmp_path, version, axes):
    path = tmp_path / "a.spz"
    gaussians = random_gaussians(2000, 3)
    save_spz(path, gaussians, "antialiased", version=version, axes=axes)
    theirs, found = read_spz(path)
    ours = load_spz(path)[0]  # axes that are not recorded are those of the specification for both
    assert found["antialiased"] and found["axes"] == ([6] if (version, axes) == (4, "rdf") else [])
    np.testing.assert_allclose(theirs.means, ours.means, atol=1e-6)
    np.testing.assert_allclose(theirs.log_scales, ours.log_scales, atol=1e-6)
    np.testing.assert_allclose(theirs.sh, ours.sh, atol=1e-6)
    assert np.abs(np.einsum("ni,ni->n", theirs.quats, ours.quats)).min() > 1 - 1e-6
    finite = np.isfinite(theirs.logit_opacities)  # infinite ones are not in the JSON
    np.testing.assert_allclose(theirs.opacities[finite], ours.opacities[finite], atol=1e-6)


@pytest.mark.foreign
@pytest.mark.parametrize("version", [3, 4])
def test_we_read_what_the_library_of_niantic_writes(tmp_path, version):
    path = tmp_path / "a.spz"
    gaussians = random_gaussians(2000, 3)
    write_spz(gaussians, path, version)
    means, *others, sh = BOUNDS[".spz"](gaussians)
    # It has 12 fractional bits, and rounds down where we round to nearest.
    bounds = (max(means, 1 / 4096), *(2 * bound for bound in others), 2 * sh)
    assert_within(load_spz(path)[0], gaussians, bounds)
