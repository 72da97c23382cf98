"""Time and memory of a training in blocks over the number of photos of a town from the air.

Usage: python tests/blocks/measure_town.py FOLDER -o RESULT.json COUNT [COUNT ...]

For each COUNT, ray traces photos of a town that grows with them into FOLDER, and trains it by `clsplat train
--blocks auto` in a process of its own. The memory limit is the same for all: a third of what the scene of `FIRST`
photos needs. A block trains the usual number of iterations for its photos, without a fewest number, which is for
scenes of few photos. Counts that RESULT.json has are not measured again, and an interrupted training goes on.
"""

import argparse
import gc
import json
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from town import write_town

from clsplat.atomic import replacing
from clsplat.blocks.settings import REFINING_LENGTHS
from clsplat.blocks.whole import BLOCKS
from clsplat.device import Device
from clsplat.training.memory import Footprint

WIDTH, HEIGHT = 120, 90

PER_PHOTO = 300
"""Gaussians per photo: 0.03 per pixel, as 6 million for 100 photos of 2 megapixels."""

FIRST = 100
"""Photos of the scene that needs three times the limit."""


def limit() -> int:
    """Bytes of device memory."""
    need = Footprint(WIDTH, HEIGHT, 3, gpu=False).total(FIRST * PER_PHOTO)
    return need // 3


def train(data: Path, out: Path, count: int) -> None:
    """Train in this process, and print what it took."""
    from clsplat import cli
    from clsplat.training import run_length

    run_length.FEWEST_ITERATIONS = 1
    resume = ["--resume"] if (out / BLOCKS).exists() else []
    settings = {
        "blocks": "auto",
        "size": "fixed",
        "max-gaussians": count * PER_PHOTO,
        "memory-limit": f"{limit() / 1e6}MB",
    }
    flags = [word for name, value in settings.items() for word in (f"--{name}", str(value))]
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    begin = time.process_time()
    cli.main(["train", str(data), "-o", str(out), "--eval-every", "0", *flags, *resume])
    found = {
        "processor seconds": round(time.process_time() - begin, 1),
        "resumed": bool(resume),
        "MB on the device": round(max(o.memory_peak for o in gc.get_objects() if isinstance(o, Device)) / 1e6, 2),
        "MB resident": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3, 1),
        "MB resident before": round(before / 1e3, 1),
    }
    print(json.dumps(found))


def measure(folder: Path, count: int) -> dict[str, Any]:
    """Make a town, and train it in another process."""
    data, out = folder / f"town-{count}", folder / f"run-{count}"
    if not (data / "transforms.json").exists():
        write_town(data, count, WIDTH, HEIGHT)
    command = [sys.executable, __file__, str(data), "-o", str(out), str(count), "--train"]
    printed = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    found: dict[str, Any] = json.loads(printed.splitlines()[-1])
    log = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
    return found | {
        "MB limit": round(limit() / 1e6, 2),
        "MB needed at once": round(Footprint(WIDTH, HEIGHT, 3, gpu=False).total(count * PER_PHOTO) / 1e6, 1),
        "blocks": len(list((out / BLOCKS).glob("*.jsonl"))) // (1 + len(REFINING_LENGTHS)),
        "iterations": log[-1]["iteration"],
        "Gaussians": log[-1]["num_gaussians"],
        "PSNR": round(log[-1].get("psnr", float("nan")), 2),
    }


def exponents(results: dict[str, Any]) -> dict[str, float]:
    """Powers of the number of photos with which time and memory grow."""
    counts = np.log([int(count) for count in results])
    names = ("processor seconds", "MB on the device", "MB resident")
    return {name: float(np.polyfit(counts, np.log([one[name] for one in results.values()]), 1)[0]) for name in names}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("counts", type=int, nargs="*")
    parser.add_argument("-o", "--out", type=Path)
    parser.add_argument("--train", action="store_true")
    options = parser.parse_intermixed_args()
    if options.train:
        train(options.folder, options.out, *options.counts)
        return
    results = json.loads(options.out.read_text()) if options.out.exists() else {}
    for count in options.counts:
        if str(count) not in results:
            results[str(count)] = measure(options.folder, count)
            print(count, results[str(count)], file=sys.stderr)
            with replacing(options.out) as file:
                file.write(f"{json.dumps(results, indent=1)}\n".encode())
    if len(results) > 1:
        for name, power in exponents(results).items():
            print(f"{name} grow with the power {power:.2f} of the photos", file=sys.stderr)


if __name__ == "__main__":
    main()
