"""Write the files of tests/formats/foreign by programs that are not ours, for the tests that need no network.

Run it as ``PYTHONPATH=.:tests/formats python tests/formats/make_foreign.py`` after `make foreign-packages`.
"""

from pathlib import Path

import numpy as np
from bounds import random_gaussians
from foreign_code import SCRIPTS, splat_transform, write_ksplat, write_spz

from clsplat.formats import save_gaussians

N, DEGREE = 40, 2


def main():
    source = random_gaussians(N, DEGREE, seed=3)
    source.means *= 4  # several buckets of a .ksplat
    # splat-transform's SOG drops colours at opacity 0.
    np.maximum(source.logit_opacities, -4, out=source.logit_opacities)
    ply = SCRIPTS / "source.ply"
    save_gaussians(ply, source)
    for level in range(3):
        write_ksplat(ply, SCRIPTS / f"mkkellogg-{level}.ksplat", level, DEGREE)
    for version in (3, 4):
        write_spz(source, SCRIPTS / f"niantic-{version}.spz", version)
    for name in ("st.glb", "st.spz", "st.sog", "st.compressed.ply", "st.csv"):
        splat_transform(ply, SCRIPTS / name)
    folder = Path(SCRIPTS / "streamed")
    folder.mkdir(exist_ok=True)
    coarse = folder / "coarse.ply"
    save_gaussians(coarse, source.take(np.arange(0, N, 4)))
    splat_transform(ply, "-l", 0, coarse, "-l", 1, folder / "lod-meta.json")
    coarse.unlink()


if __name__ == "__main__":
    main()
