"""Time and memory of levels of detail over the size of the scene.

Usage: python tests/pruning/measure_levels.py SCENE FOLDER -o RESULT.json SIZE [SIZE ...]

Copies of SCENE, side by side on a square, make a PLY of SIZE Gaussians in FOLDER, which needs a disk with room for
four times its bytes. Coefficients of colours differ by 2 % at random from copy to copy, so that palettes find no two
alike. `clsplat export PLY LEVELS` runs in a process of its own, whose largest resident size is measured beside the
time of each step. Sizes that RESULT.json has are not measured again. Set OPENBLAS_NUM_THREADS=1 on a busy machine.
"""

import argparse
import json
import resource
import shutil
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.atomic import replacing
from clsplat.commands.files import Export
from clsplat.formats import load_gaussians, streamed_sog, tiles_3d
from clsplat.formats.ply import save_ply_parts
from clsplat.gaussians import Gaussians
from clsplat.pruning import levels

NOISE = 0.02
"""Relative deviation of colours between copies."""

INNER = (0.02, 0.98)
"""Quantiles of the means between which a copy extends; the few beyond overlap its neighbours."""

LOCK = threading.Lock()


def tiled(scene: Gaussians, count: int) -> Iterator[Gaussians]:
    """Copies of a scene on a square in the plane of its two longest axes, `count` Gaussians in all."""
    low, high = np.quantile(scene.means, INNER, axis=0)
    extent = high - low
    first, second = np.argsort(-extent)[:2]
    side = int(np.ceil(np.sqrt(count / len(scene))))
    for copy in range(-(-count // len(scene))):
        rng = np.random.default_rng(copy)
        part = scene.astype(np.float32)
        part.means[:, first] += (copy % side) * extent[first]
        part.means[:, second] += (copy // side) * extent[second]
        part.sh *= rng.normal(1, NOISE, part.sh.shape).astype(np.float32)
        yield part.take(np.arange(min(len(scene), count - copy * len(scene))))


def timed(seconds: Counter[str], name: str, call: Callable[..., Any]) -> Callable[..., Any]:
    """A function that adds the processor time of its thread to a counter."""

    def wrapped(*args: Any, **settings: Any) -> Any:
        begin = time.thread_time()
        try:
            return call(*args, **settings)
        finally:
            with LOCK:
                seconds[name] += time.thread_time() - begin

    return wrapped


def export(ply: Path, out: Path) -> dict[str, Any]:
    """Export levels in this process; return what it took."""
    seconds: Counter[str] = Counter()
    levels.halved = timed(seconds, "halve", levels.halved)
    for module, name in ((streamed_sog.StreamedSogWriter, "streamed SOG"), (tiles_3d.TilesWriter, "3D Tiles")):
        module.add = timed(seconds, name, module.add)  # type: ignore[method-assign]
    before, wall = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.perf_counter()
    begin = time.process_time()
    Export(ply, out).run()
    whole = time.process_time() - begin
    seconds["read, cut and join"] = whole - sum(seconds.values())
    return {
        "processor seconds": round(whole, 1),
        "wall seconds": round(time.perf_counter() - wall, 1),
        "steps": {name: round(value, 1) for name, value in seconds.items()},
        "MB resident": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3),
        "MB resident before": round(before / 1e3),
    }


def measure(scene: Gaussians, count: int, folder: Path) -> dict[str, Any]:
    """Make a scene of a size, and export it in another process."""
    ply, out = folder / f"{count}.ply", folder / f"levels-{count}"
    save_ply_parts(ply, tiled(scene, count), count, scene.sh.shape[1])
    try:
        command = [sys.executable, "-P", __file__, str(ply), str(out), "--export"]
        found = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
        sog = sum(path.stat().st_size for path in out.rglob("*.webp"))
        tiles = sum(path.stat().st_size for path in out.glob("*.glb"))
        return found | {
            "PLY MB": round(ply.stat().st_size / 1e6),
            "streamed SOG MB": round(sog / 1e6),
            "3D Tiles MB": round(tiles / 1e6),
            "levels": json.loads((out / streamed_sog.LOD_META).read_text())["counts"],
        }
    finally:
        ply.unlink()
        shutil.rmtree(out, ignore_errors=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").replace("%", "%%"))
    parser.add_argument("scene", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("sizes", type=int, nargs="*")
    parser.add_argument("-o", "--out", type=Path)
    parser.add_argument("--export", action="store_true")
    options = parser.parse_intermixed_args()
    if options.export:
        print(json.dumps(export(options.scene, options.folder)))
        return
    results = json.loads(options.out.read_text()) if options.out.exists() else {}
    scene = load_gaussians(options.scene)[0]
    options.folder.mkdir(parents=True, exist_ok=True)
    for count in options.sizes:
        if str(count) not in results:
            results[str(count)] = measure(scene, count, options.folder)
            print(count, results[str(count)], file=sys.stderr)
            with replacing(options.out) as file:
                file.write(f"{json.dumps(results, indent=1)}\n".encode())
    counts = np.array([int(count) for count in results])
    seconds = np.array([results[str(count)]["processor seconds"] for count in counts])
    if len(counts) > 1:
        exponent = np.polyfit(np.log(counts), np.log(seconds), 1)[0]
        print(f"processor time grows with the power {exponent:.2f} of the size", file=sys.stderr)


if __name__ == "__main__":
    main()
