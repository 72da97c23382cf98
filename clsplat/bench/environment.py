"""The environment of a measurement: date, device, driver and software."""

import os
import platform
import subprocess
from datetime import datetime, timezone
from importlib.metadata import version
from pathlib import Path
from typing import Any

from clsplat.device import Device


def commit() -> str | None:
    """Commit of the checkout that this package runs from, with a + if files differ from it; None if there is none."""
    root = Path(__file__).resolve().parents[2]

    def git(*arguments: str) -> str:
        done = subprocess.run(["git", *arguments], cwd=root, capture_output=True, text=True, check=True)
        return done.stdout.strip()

    if not (root / ".git").exists():
        return None
    try:
        changed = git("status", "--porcelain", "--untracked-files=no", "--", "clsplat", "cl")
        return git("rev-parse", "HEAD") + ("+" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return None


def describe(device: Device) -> dict[str, Any]:
    """Date, device, driver and software. `load` is the load average at the start of the measurement (Unix only)."""
    d = device.cl_device
    return {
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "load": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
        "device": {
            "label": device.label,
            "kind": "cpu" if device.is_cpu else "gpu",
            "driver": d.driver_version.strip(),
            "opencl": d.version.strip(),
            "compute_units": d.max_compute_units,
            "memory_gib": d.global_mem_size / 2**30,
        },
        "software": {
            "clsplat": version("clsplat"),
            "commit": commit(),
            "python": platform.python_version(),
            "pyopencl": version("pyopencl"),
        },
    }
