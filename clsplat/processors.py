"""Processors that the compiler of PoCL does not know, or takes for an older one.

PoCL asks LLVM for the name of the processor and hands it to Clang. For a processor that is newer than that LLVM the
name is "generic", which Clang refuses, so that no kernel can be built (https://github.com/pocl/pocl/issues/1049).
LLVM 14, of the embedded PoCL 3.0, knows no AMD processor after Zen 3; it takes a Zen 4 for a Zen 3, without AVX-512.
No option and no environment variable sets the name. Therefore it is replaced in PoCL's own description of the device,
on Linux, by the level of the x86-64 architecture that the processor has.
"""

import ctypes
import re
import struct
from pathlib import Path
from typing import IO, Any

MISNAMED = re.compile(rb"generic|znver[123]")
"""Names that LLVM 14 gives to processors that it does not know, or may take for an older one."""

AVX512 = "x86-64-v4"
"""Level with vectors of 16 floats."""

LEVELS = {
    AVX512: "avx512f avx512bw avx512cd avx512dq avx512vl",
    "x86-64-v3": "avx avx2 bmi1 bmi2 f16c fma abm movbe xsave",
    "x86-64-v2": "cx16 lahf_lm popcnt pni sse4_1 sse4_2 ssse3",
    "x86-64": "",
}
"""Levels of the architecture, and the features that each adds to those below, as Linux names them (x86-64 psABI,
section 3.1.1)."""

DESCRIPTION_WORDS = 128
"""Words at the begin of the description of a device that are searched. PoCL 1.2 to 3.1 have the name in word 80."""

NAME_LENGTH = 16
"""Bytes that are read of a name: more than the longest of those that are compared."""


def level_of(flags: set[str]) -> str:
    """Highest level of the x86-64 architecture whose features, and those of all levels below, are among `flags`."""
    needed = [set(features.split()) for features in LEVELS.values()]
    return next(name for i, name in enumerate(LEVELS) if set().union(*needed[i:]) <= flags)


def name_processor(device: Any) -> str | None:
    """Replace the name of the processor that PoCL gives to its compiler, where it is wrong.

    Parameters
    ----------
    device : pyopencl.Device

    Returns
    -------
    str or None
        The level that is named now; None where the name is right or cannot be replaced, and for other drivers.
    """
    if "pocl" not in str(getattr(device, "version", "")).lower():
        return None
    try:
        flags = set(re.findall(r"^flags\s*:(.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)[0].split())
        # Unlike a pointer, this file can be read at any address: there is an error where nothing is mapped.
        with open("/proc/self/mem", "rb", buffering=0) as memory:
            found = _find_name(memory, device.int_ptr)
    except (OSError, IndexError):
        return None
    if not found:
        return None
    place, name = found
    level = level_of(flags)
    if name == level.encode():
        return level
    if not MISNAMED.fullmatch(name) or (name != b"generic" and level != AVX512):
        return None
    copy = ctypes.CDLL(None).strdup  # by the allocator with which PoCL may free it
    copy.restype = ctypes.c_void_p
    ctypes.c_void_p.from_address(place).value = copy(level.encode())
    return level


def vector_width(device: Any, level: str | None) -> int:
    """Number of floats in the vectors of kernels for CPUs: 16 if the compiler has registers for them, else 8.

    Parameters
    ----------
    device : pyopencl.Device
    level : str or None
        Result of `name_processor`. Without it, a Zen is taken for one without AVX-512, whatever the device reports.
    """
    if level:
        return 16 if level == AVX512 else 8
    wide = getattr(device, "native_vector_width_float", 1) >= 16
    return 16 if wide and "znver" not in str(getattr(device, "version", "")) else 8


def _find_name(memory: IO[bytes], description: int) -> tuple[int, bytes] | None:
    """Address of the pointer to the processor's name, which follows that to the compiler's target, and the name."""
    memory.seek(description)
    words = struct.unpack(f"{DESCRIPTION_WORDS}Q", memory.read(8 * DESCRIPTION_WORDS))
    for index in range(1, DESCRIPTION_WORDS):
        if _text(memory, words[index - 1]).startswith(b"x86_64-"):
            return description + 8 * index, _text(memory, words[index])
    return None


def _text(memory: IO[bytes], address: int) -> bytes:
    """The begin of a text; nothing if nothing is mapped at the address."""
    try:
        memory.seek(address)
        return memory.read(NAME_LENGTH).split(b"\0")[0]
    except (OSError, OverflowError):
        return b""
