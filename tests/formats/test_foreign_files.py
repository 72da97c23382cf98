"""Files of other programs: trained scenes next to the project, and splat-transform in both directions."""

import numpy as np
import pytest
from bounds import BOUNDS, assert_within, matched, random_gaussians, save
from foreign_code import splat_transform

from clsplat.formats import load_gaussians
from clsplat.formats.spz import load_spz

# Formats that splat-transform reads. A .ply is not listed: its reader is compared with the other formats' readers.
THEIRS = [".compressed.ply", ".splat", ".spz", ".sog"]

# Number of Gaussians according to data/README.md, and SH degree.
SCENES = {
    "truck.splat": (116_544, 0),
    "biker.spz": (152_746, 0),
    "biker.compressed.ply": (152_746, 0),
    "guitar.compressed.ply": (90_854, 0),
    "st-peter.sog": (133_618, 0),
    "learnpc_sh3": (185_761, 3),
}


@pytest.mark.shared
@pytest.mark.parametrize("name", SCENES)
def test_scenes_of_others_are_read(shared, name):
    gaussians, mode, offset = load_gaussians(shared / "data" / "splats" / name)
    assert (len(gaussians), gaussians.sh_degree) == SCENES[name]
    assert all(np.isfinite(array).all() for array in gaussians.arrays().values())
    assert mode == "classic" and not offset.any()
    # A trained scene, not noise: most scales are far below the extent of the scene, and colours can be displayed.
    extent = np.ptp(np.quantile(gaussians.means, [0.05, 0.95], axis=0), axis=0).max()
    assert np.median(gaussians.scales.max(axis=1)) < 0.05 * extent
    assert np.quantile(np.abs(gaussians.sh[:, 0]), 0.9) < 3


@pytest.mark.shared
def test_two_files_of_one_scene_agree(shared):
    """The same Gaussians as .spz and .compressed.ply must have the same axes, rotations, scales and colours."""
    folder = shared / "data" / "splats"
    spz = load_gaussians(folder / "biker.spz")[0]
    ply = load_gaussians(folder / "biker.compressed.ply")[0]
    # Both have the same order, except for Gaussians that nearly coincide.
    same = np.abs(spz.means - ply.means).max(axis=1) < 2e-3
    assert same.mean() > 0.99
    spz, ply = spz.take(same), ply.take(same)
    # Half a step of both formats: 1/32, and a chunk's range of a few units divided by 2046; 1/76.5, and a range
    # divided by 510.
    assert np.quantile(np.abs(spz.log_scales - ply.log_scales)[ply.log_scales.min(axis=1) > -10], 0.999) < 0.04
    assert np.abs(spz.sh - ply.sh).max() < 1 / 76.5 + 3.6 / 510 / 0.28
    assert np.abs(spz.opacities - ply.opacities).max() <= 1 / 255 + 1e-6
    cosine = np.abs(np.einsum("ni,ni->n", spz.quats, ply.quats))
    assert cosine.min() > 0.99999


def stored(path):
    """The Gaussians of a file as splat-transform reads it: it takes the axes of an .spz for those of a PLY."""
    return load_spz(path, "rdf")[0] if path.suffix == ".spz" else load_gaussians(path)[0]


def assert_same(found, expected, quats=1e-5):
    """Check that two readers of one file agree within float32."""
    np.testing.assert_allclose(found.means, expected.means, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(found.log_scales, expected.log_scales, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(found.opacities, expected.opacities, atol=2e-6)
    np.testing.assert_allclose(found.sh, expected.sh, atol=2e-6)
    sign = np.sign(np.einsum("ni,ni->n", found.quats, expected.quats))[:, None]
    np.testing.assert_allclose(found.quats * sign, expected.quats, atol=quats)


@pytest.mark.foreign
@pytest.mark.parametrize("suffix", THEIRS)
def test_splat_transform_reads_what_we_write(tmp_path, suffix):
    gaussians = random_gaussians(3000, degree=0 if suffix == ".splat" else 3)
    path = tmp_path / f"ours{suffix}"
    save(path, gaussians)
    splat_transform(path, tmp_path / "theirs.ply")
    # It decodes the quaternions of a .splat as 127.5 q + 127.5, half a step off the original viewer.
    assert_same(load_gaussians(tmp_path / "theirs.ply")[0], stored(path), 0.01 if suffix == ".splat" else 1e-5)


@pytest.mark.foreign
@pytest.mark.parametrize(
    ("suffix", "options"),
    [(".spz", ["--spz-version", 3]), (".spz", ["--spz-version", 4]), (".compressed.ply", []), (".sog", ["-i", 2])],
)
def test_we_read_what_splat_transform_writes(tmp_path, suffix, options):
    gaussians = random_gaussians(1500, degree=3)
    np.maximum(
        gaussians.logit_opacities, -4, out=gaussians.logit_opacities
    )  # its SOG writer drops colours at opacity 0
    save(tmp_path / "ours.ply", gaussians)
    path = tmp_path / f"theirs{suffix}"
    splat_transform(*options, tmp_path / "ours.ply", path)
    found = stored(path)
    splat_transform(path, tmp_path / "again.ply")
    assert_same(found, load_gaussians(tmp_path / "again.ply")[0])
    # It rounds down where we round to nearest, positions of .spz to 1/4096; its codebooks and palette have no bound.
    means, log_scales, opacities, quats, sh0, _ = BOUNDS[suffix](gaussians)
    means = np.maximum(2 * means, 1 / 8192) if suffix == ".spz" else 2 * means
    sh = {".spz": 8.5 / 128, ".sog": 2.0}.get(suffix, 1 / 32)
    bounds = (means, 4 * log_scales, 2 * opacities, 2 * quats, 4 * sh0, sh)
    assert_within(matched(found, gaussians), gaussians, bounds)
