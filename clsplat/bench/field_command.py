"""The sub-command `clsplat bench fields`."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from clsplat.bench.bench_commands import check_files, say, write_results
from clsplat.config import UINT32_MAX, Count
from clsplat.errors import InputError
from clsplat.ranges import within


@dataclass(frozen=True)
class Fields:
    """Account for the time of radiance fields: evaluations, operations and bytes per pixel, and shares of stages."""

    data: tyro.conf.Positional[str]
    """Dataset, with options as for `bench quality`: lego:downscale=4:background=white."""
    methods: tuple[str, ...] = ("nerf-small", "plenoxels", "ingp-base", "mip-nerf360-small")
    """Radiance fields, as for --method of `train`."""
    iterations: Annotated[int, within(least=0, most=UINT32_MAX), tyro.conf.arg(metavar="INT")] = 100
    """Steps before those that are counted. Grids of occupied cells find the empty ones meanwhile."""
    repeats: Count = 5
    """Number of steps that are counted."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """JSON file for all results."""
    device: str | None = None
    """Part of the platform's or device's name."""

    def run(self) -> None:
        """Run the command."""
        from clsplat.bench.cells import parse_source
        from clsplat.bench.field_account import bench_fields, fields_text
        from clsplat.dataset import load_scene
        from clsplat.device import Device, select_device
        from clsplat.fields import METHODS

        check_files(self.out, "--out", None)
        for name in self.methods:
            if name not in METHODS:
                raise InputError(f"--methods: expected some of {', '.join(METHODS)}, found {name}")
        source = parse_source(self.data)
        data = replace(source.data, random_background=True)
        scene, device = load_scene(source.path, data), Device(select_device(self.device))
        say(f"device: {device.label}")
        methods = [METHODS[name] for name in self.methods]
        results = bench_fields(methods, scene, data, device, self.iterations, self.repeats, say)
        results["settings"]["scene"] = source.name
        write_results(self.out, results)
        print(fields_text(results))
