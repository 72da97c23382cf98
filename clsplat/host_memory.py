"""Memory of the machine, or of the container in which the process runs."""

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

OWN_GROUPS = Path("/proc/self/cgroup")
"""File with the control groups of this process. Linux limits the memory of containers by them."""

GROUPS = Path("/sys/fs/cgroup")
"""Folder of the control groups: of version 2, and in ``memory`` of version 1."""


def physical_memory() -> int | None:
    """Memory in bytes that this process may take; None where the system does not tell it."""
    try:
        machine = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError):  # Windows has no sysconf
        return None
    return min(machine, *_limits_of_groups(), machine)


def _limits_of_groups() -> Iterator[int]:
    """Limits of the process's control group and those around it."""
    with suppress(OSError, ValueError):  # not Linux
        for line in OWN_GROUPS.read_text(encoding="utf-8").splitlines():
            _, controllers, name = line.split(":", 2)
            version_1 = "memory" in controllers.split(",")
            if controllers and not version_1:
                continue
            root, file = (GROUPS / "memory", "memory.limit_in_bytes") if version_1 else (GROUPS, "memory.max")
            group = root / name.lstrip("/")
            for folder in (group, *group.parents[: len(group.parts) - len(root.parts)]):
                # A container sees its own group as the root, under whatever name. Without a limit, the file says max.
                with suppress(OSError, ValueError):
                    yield int((folder / file).read_text(encoding="ascii"))
