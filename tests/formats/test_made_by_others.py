"""Files that programs of others wrote from `foreign/source.ply` (make_foreign.py), read without a network."""

import csv

import numpy as np
import pytest
from bounds import SLACK, matched
from foreign_code import SCRIPTS

from clsplat.constants import SH_C0
from clsplat.formats import load_gaussians
from clsplat.formats.spz import load_spz
from clsplat.reference.project import rotations

FILES = {
    # Largest errors of means, log_scales, opacities, covariances (relative), sh of band 0, sh above.
    "st.glb": (1e-6, 1e-6, 1e-6, 1e-5, 1e-6, 1e-6),
    "st.spz": (1 / 4096, 1 / 16, 1 / 255, 0.2, 2 / 76.5, 1 / 15),
    "st.sog": (5e-3, 0.3, 1 / 255, 0.6, 0.4, 1.0),
    "st.compressed.ply": (0.02, 0.01, 1 / 255, 0.05, 0.02, 1 / 32),
    "niantic-3.spz": (1 / 4096, 1 / 16, 1 / 255, 0.2, 2 / 76.5, 1 / 64),
    "niantic-4.spz": (1 / 4096, 1 / 16, 1 / 255, 0.2, 2 / 76.5, 1 / 64),
    "mkkellogg-0.ksplat": (1e-6, 1e-6, 1 / 255, 1e-5, 1 / 255 / SH_C0, 1e-6),
    "mkkellogg-1.ksplat": (2e-4, 2e-3, 1 / 255, 0.01, 1 / 255 / SH_C0, 1e-3),
    "mkkellogg-2.ksplat": (2e-4, 2e-3, 1 / 255, 0.01, 1 / 255 / SH_C0, 1 / 128),
    "streamed": (5e-3, 0.3, 1 / 255, 0.6, 0.4, 1.0),
    "streamed/lod-meta.json": (5e-3, 0.3, 1 / 255, 0.6, 0.4, 1.0),
}


def covariances(gaussians):
    """Covariances (N, 3, 3), which tell the same orientations of an ellipsoid from others."""
    axes = rotations(gaussians.quats.astype(np.float64)) * np.exp(gaussians.log_scales.astype(np.float64))[:, None]
    return axes @ axes.transpose(0, 2, 1)


@pytest.mark.parametrize("name", FILES)
def test_files_of_others(name):
    source = load_gaussians(SCRIPTS / "source.ply")[0]
    path = SCRIPTS / name
    # splat-transform writes the axes of a PLY, and does not say so.
    found, mode, offset = load_spz(path, "rdf") if name == "st.spz" else load_gaussians(path)
    found = matched(found, source)
    means, log_scales, opacities, shapes, sh0, sh = (bound * SLACK for bound in FILES[name])
    assert np.abs(found.means - source.means).max() <= means
    assert np.abs(found.log_scales - source.log_scales).max() <= log_scales
    assert np.abs(found.opacities - source.opacities).max() <= opacities
    assert np.abs(found.sh[:, 0] - source.sh[:, 0]).max() <= sh0
    assert np.abs(found.sh[:, 1:] - source.sh[:, 1:]).max() <= sh
    expected = covariances(source)
    errors = np.linalg.norm(covariances(found) - expected, axis=(1, 2)) / np.linalg.norm(expected, axis=(1, 2))
    assert errors.max() <= shapes
    assert mode == "classic" and not offset.any()


def test_the_columns_of_a_table_of_others():
    """The values of splat-transform's .csv, whose names are those of ours."""
    source = load_gaussians(SCRIPTS / "source.ply")[0]
    with open(SCRIPTS / "st.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    for name, values in {
        "x": source.means[:, 0],
        "opacity": source.logit_opacities,
        "rot_0": source.quats[:, 0],
    }.items():
        np.testing.assert_allclose([float(row[name]) for row in rows], values, rtol=1e-6)
