"""Measure the rows of docs/stability.md that need real scenes, which the package does not contain.

Run by `make bench-stability DATA=FOLDER`, after `clsplat bench stability` has measured the other rows.
"""

import argparse
import sys
from pathlib import Path

from scene_experiments import SCENE_EXPERIMENTS, experiments_on

from clsplat.bench.stability.run import measure_rows
from clsplat.bench.stability.stability_report import table
from clsplat.device import Device, select_device
from clsplat.errors import ClsplatError


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help=f"experiments, default: all ({', '.join(SCENE_EXPERIMENTS)})")
    parser.add_argument("--data", type=Path, required=True, help="folder with the real scenes")
    parser.add_argument("-o", "--out", type=Path, help="folder for the rows in stability.json, and for charts")
    parser.add_argument("--device", help="part of the platform's or device's name")
    options = parser.parse_args(arguments)
    if not options.data.is_dir():
        parser.error(f"{options.data}: expected a folder that exists, found none")
    experiments = experiments_on(options.data)
    try:
        device = Device(select_device(options.device))
        results, failed = measure_rows(
            options.names, device, options.out, lambda text: print(text, file=sys.stderr, flush=True), experiments
        )
    except ClsplatError as error:
        parser.error(str(error))
    print(table(results, experiments))
    if failed:
        parser.exit(1, f"experiments failed, see above: {', '.join(failed)}\n")


if __name__ == "__main__":
    main()
