"""Parts of captures that seem to move at the first look: of all photos, and of the photo with the largest one.

python tests/training/measure_moving.py DATASET:thin=4 ...    # as clsplat bench quality takes them
"""

import sys
import tempfile

import numpy as np

from clsplat.bench.cells import parse_source
from clsplat.bench.quality import Reader
from clsplat.config import TrainConfig
from clsplat.gaussians import Gaussians
from clsplat.renderer import Renderer
from clsplat.scene import View
from clsplat.training import session
from clsplat.training.loop import train
from clsplat.training.moving import Masks, evidence_of, seeds_of
from clsplat.training.preparation import prepare


class Looked(Exception):
    """Ends a training after its first look, with the parts of its photos."""


def look(renderer: Renderer, gaussians: Gaussians, views: list[View], sh_degree: int) -> Masks:
    """Measure in place of `clsplat.training.moving.moving`."""
    raise Looked([float(seeds_of(each).mean()) for each in evidence_of(renderer, gaussians, views, sh_degree)])


def main(texts: list[str]) -> None:
    """Print a line for each capture."""
    session.moving = look
    for text in texts:
        source = parse_source(text)
        scene, config = prepare(source.path, TrainConfig(data=source.data), scene=Reader().read(source)[0])
        with tempfile.TemporaryDirectory() as folder:
            try:
                train(scene, config, folder)
            except Looked as looked:
                parts = looked.args[0]
        print(f"{source.name}, {len(parts)} photos: {np.mean(parts):.4f}, at most {max(parts):.3f}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
