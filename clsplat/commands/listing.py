"""The command `devices`."""

import re
import sys
from ctypes.util import find_library
from dataclasses import dataclass
from typing import Any

from clsplat.commands.console import say

KNOWN_FAULTS = (
    (
        r"PoCL (3\.0|3\.1) .*(znver|generic)",
        "takes a Zen 4 for a Zen 3 and does not know later processors (clsplat names their features on Linux)",
    ),
    (
        r"rusticl .*\b22\.",
        "no double precision; compiles slowly; on llvmpipe, loops seem to end after 65 535 rounds",
    ),
    (
        r"rusticl .*\b25\.",
        "declares subgroups in OpenCL C 3.0 alone, although it names the extension",
    ),
    (
        r"AMD Accelerated Parallel Processing",
        "names cl_khr_subgroups, and its compiler does not declare their functions in OpenCL C 1.2",
    ),
)
"""Drivers, as patterns of platform, version and driver version, and what is known to be wrong with them (tried in:
docs/howto/devices.md)."""

NVIDIA = "nvidia-opencl"
"""Name of the library of NVIDIA's driver for OpenCL, for the linker."""


@dataclass(frozen=True)
class Devices:
    """List the OpenCL devices and their capabilities, and test each: every stage against the float64 reference."""

    check: bool = False
    """Exit with status 1 if a device fails the test."""

    def run(self) -> None:
        """Run the command."""
        from clsplat.device import list_devices, select_device
        from clsplat.selftest import TESTS, faults_of

        default, devices = select_device(), list_devices()
        starred = devices.index(default)  # one of them, even where two entries of a driver are equal
        failed = False
        for index, device in enumerate(devices):
            describe(device, starred=index == starred)
            say("    testing ...")
            faults = faults_of(index)
            failed |= bool(faults)
            if not faults:
                print(f"    works: all {len(TESTS)} stages agree with the reference")
            for stage, fault in faults.items():
                print(f"    FAILS: {stage}: {fault}")
        print("* is the default; choose another device with --device and part of its name, or with PYOPENCL_CTX")
        library = find_library(NVIDIA)
        if library and not any("NVIDIA" in device.platform.name for device in devices):
            print(
                f"NVIDIA's driver is installed ({library}), but OpenCL shows no device of it. In containers, the "
                "list of drivers often lacks it: docs/howto/install.md, NVIDIA GPU, says what to do"
            )
        if self.check and failed:
            sys.exit(1)


def describe(device: Any, starred: bool) -> None:
    """Print the name, the capabilities and the known faults of a device."""
    from clsplat.device import device_label
    from clsplat.programs import ask

    extensions, memory = ask(device, "extensions", ""), ask(device, "global_mem_size", 0)
    version, driver = ask(device, "version", "").strip(), ask(device, "driver_version", "").strip()
    capabilities = [
        f"{ask(device, 'max_compute_units', 0)} compute units",
        f"{memory / 2**30:.1f} GiB, {ask(device, 'max_mem_alloc_size', 0) / 2**30:.1f} GiB per buffer",
        f"{ask(device, 'local_mem_size', 0) // 1024} KiB local",
        f"{version}, driver {driver}",
        "double precision" if "cl_khr_fp64" in extensions else "no double precision",
        "subgroups" if "subgroups" in extensions else "no subgroups",
    ]
    print(f"{'*' if starred else ' '} {device_label(device)}\n    {'; '.join(capabilities)}")
    for pattern, fault in KNOWN_FAULTS:
        if re.search(pattern, f"{device.platform.name} {version} {driver}"):
            print(f"    known: {fault}")
