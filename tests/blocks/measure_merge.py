"""Rates and memory of the merge of blocks, and of the index from which second trainings read.

Usage: python tests/blocks/measure_merge.py FOLDER [GAUSSIANS [BLOCKS]]

Writes BLOCKS results (default: 4) of GAUSSIANS random Gaussians each (default: 500 000, SH degree 3) into FOLDER, and
prints for the merge, the index and a read of all parts the processor time per million Gaussians, and how much the
largest resident size of this process grew meanwhile. Then the same for an evaluation's read of what 16 photos show,
per million Gaussians of the first result, at which they look; the others are far above. And for the search of what
400 photos may show, in a part that none of them shows: the others need less.
"""

import resource
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from town import flight

from clsplat.blocks.block import result_of
from clsplat.blocks.parts import read_index, read_part, write_index
from clsplat.blocks.sight import Bounds, seen
from clsplat.blocks.stored import BATCH, StoredScene
from clsplat.blocks.whole import merge
from clsplat.camera import Camera
from clsplat.config import RenderConfig
from clsplat.formats.ply import save_ply_parts
from clsplat.formats.ply_parts import CHUNK
from clsplat.renderer import Renderer
from clsplat.testing import synthetic_scene


def measured(name: str, count: int, call: Callable[[], object]) -> None:
    before, begin = resident(), time.process_time()
    call()
    used = time.process_time() - begin
    grown = resident() - before
    print(f"{name}: {1e6 * used / count:.2f} s of processor time per million Gaussians, {grown:.0f} MB more resident")


def camera_of_first(k: int, z: float) -> Camera:
    """One of the cameras around the first result, whose Gaussians are within 1.5 of (0, 0, z), below the others."""
    angle = 2 * np.pi * k / BATCH
    eye = 4 * np.cos(angle), 4 * np.sin(angle), z + 1
    return replace(Camera.look_at(eye, (0, 0, z), (0, 0, 1), 160, 160, 120), near=0.01)


def resident() -> float:
    """Largest resident size so far, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def main() -> None:
    folder, given = Path(sys.argv[1]), [int(word) for word in sys.argv[2:]]
    size, blocks = (*given, *(500_000, 4)[len(given) :])
    folder.mkdir(parents=True, exist_ok=True)
    jobs, part = [folder / f"{k}.json" for k in range(blocks)], synthetic_scene(CHUNK)[0]
    cameras, side = flight(400, 1600, 1200)
    for job in jobs:
        part.means[:, 2] += 10 * side
        parts = (part.take(np.arange(min(CHUNK, size - first))) for first in range(0, size, CHUNK))
        save_ply_parts(result_of(job), parts, size, 16)
    count, results = size * blocks, [result_of(job) for job in jobs]
    measured("merge", count, lambda: merge(results, folder / "scene.ply"))
    measured("index", count, lambda: write_index(results))
    index = write_index(results)
    measured("read", count, lambda: [len(read_part(folder, part)) for part in read_index(index)])
    whole, looking = StoredScene(folder / "scene.ply"), [camera_of_first(k, 10 * side) for k in range(BATCH)]
    measured("evaluation", size, lambda: [len(g) for _, g in whole.shown(Renderer("reference"), looking)])
    part.means[:, 0] += 10 * side
    part.log_scales[:] = 0
    measured("search", CHUNK, lambda: seen(cameras, Bounds.of(part), RenderConfig()))


if __name__ == "__main__":
    main()
