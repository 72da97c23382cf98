"""Programs: the sources in cl/, how they are built, their arguments, and what a device's compiler offers."""

import os
import re
import shutil
import warnings
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import pyopencl as cl
from numpy.typing import DTypeLike

from clsplat.errors import PROBE, BuildError, DeviceError

Answer = TypeVar("Answer")

# Options that are safe with every tested driver. -cl-fast-relaxed-math is not: it degrades or breaks exp on some.
BUILD_OPTIONS = ["-cl-mad-enable", "-cl-no-signed-zeros"]

# The language of all kernels without subgroups.
BASE_LANGUAGE = "-cl-std=CL1.2"

# Languages that may have the functions of subgroups, in the order in which they are tried, and the version of OpenCL
# from which a driver has to know each. In OpenCL C 3.0 they are a feature, in 2.0 the extension cl_khr_subgroups.
# OpenCL C 1.2 has them nowhere: Clang, from which most drivers come, does not declare them there.
SUBGROUP_LANGUAGES = (("-cl-std=CL3.0", (3, 0)), ("-cl-std=CL2.0", (2, 0)))

# Number of values of an integer argument, which has 32 bits.
WORDS = 2**32

# Name of PoCL's platform.
POCL = "Portable Computing Language"

# A kernel that calls the functions which kernels with -DSUBGROUPS=1 call.
SUBGROUP_PROBE = """
#ifdef cl_khr_subgroups
#pragma OPENCL EXTENSION cl_khr_subgroups : enable
#endif
__kernel void probe(__global uint *out) {
    __local uint handed_on;
    handed_on = get_num_sub_groups();
    if (get_num_sub_groups() == 1)
        sub_group_barrier(CLK_LOCAL_MEM_FENCE);
    else
        barrier(CLK_LOCAL_MEM_FENCE);
    out[get_global_id(0)] = handed_on;
}
"""

# Largest work-group whose subgroups are asked for. Groups of this size or smaller are launched.
PROBE_GROUP = 256


class Subgroups(NamedTuple):
    """Number of work-items in a subgroup, as the driver forms them in most kernels, and the option that selects a
    language with their functions. The number is 0 without subgroups."""

    size: int
    language: str


def kernel_folder() -> Path:
    """Folder of the OpenCL sources: inside the package when installed, next to it in a checkout."""
    here = Path(__file__).resolve().parent
    for folder in (here / "cl", here.parent / "cl"):
        if (folder / "common.h").is_file():
            return folder
    raise DeviceError(f"cl/common.h: expected the kernel sources in {here / 'cl'}, found none; reinstall clsplat")


def inline_includes(name: str, folder: Path) -> str:
    """Source of cl/`name` in which each ``#include "..."`` is replaced by the file, with #line directives.

    Compilers then report errors as cl/FILE:LINE, and the program cache of a driver cannot overlook an edited header.
    """
    lines = [f'#line 1 "cl/{name}"']
    for number, line in enumerate((folder / name).read_text().splitlines(), start=1):
        include = re.match(r'\s*#include\s+"(.+)"', line)
        if include:
            lines += [inline_includes(include[1], folder), f'#line {number + 1} "cl/{name}"']
        else:
            lines.append(line)
    return "\n".join(lines)


def build_options(real: DTypeLike, defines: dict[str, Any], language: str = BASE_LANGUAGE) -> list[str]:
    """Compiler options of a program for reals of the type `real`, float32 or float64."""
    double = np.dtype(real) == np.float64
    options = [language, *BUILD_OPTIONS, "-DUSE_DOUBLE" if double else "-cl-single-precision-constant"]
    # NumPy's float64 is a float whose repr is np.float64(...).
    return options + [
        f"-D{name}={float(value)!r}" if isinstance(value, float) else f"-D{name}={value}"
        for name, value in defines.items()
    ]


def check_space(device: cl.Device) -> None:
    """Raise a BuildError if PoCL has no space for kernels: it ends the process when it cannot write one."""
    if device.platform.name != POCL:
        return
    variables = (os.environ.get(name) for name in ("POCL_CACHE_DIR", "XDG_CACHE_HOME"))
    folder = next((Path(value) for value in variables if value), Path.home() / ".cache")
    for place in (folder, *folder.parents):  # PoCL makes what is missing
        if place.is_dir():
            free = shutil.disk_usage(place).free
            if free < PROBE:
                raise BuildError(
                    f"cannot build the kernels: the driver's compiler writes to {folder}, whose disk has {free} "
                    "bytes left; make room, or set POCL_CACHE_DIR to a folder on another disk"
                )
            return


def build(context: cl.Context, source: str, options: list[str]) -> cl.Program:
    """Build a program. What the compiler says of a successful build is shown if PYOPENCL_COMPILER_OUTPUT is set."""
    shown = bool(os.environ.get("PYOPENCL_COMPILER_OUTPUT"))
    with warnings.catch_warnings():
        # Drivers report on successful builds, for example which kernels they vectorised, and PoCL's compiler prints
        # the number of its warnings to stderr.
        if not shown:
            warnings.simplefilter("ignore", cl.CompilerWarning)
            options = [*options, "-w"]
        return cl.Program(context, source).build(options)


def ask(device: cl.Device, query: str, refused: Answer) -> Answer:
    """Answer of a device to a query, by its name in pyopencl; `refused` if the driver does not answer it."""
    try:
        return type(refused)(getattr(device, query))  # type: ignore[call-arg]
    except (cl.Error, AttributeError, TypeError, ValueError):
        return refused


def opencl_version(device: cl.Device) -> tuple[int, int]:
    """Version of OpenCL that a device implements; (1, 0) if it does not say."""
    found = re.match(r"OpenCL (\d+)\.(\d+)", ask(device, "version", ""))
    return (int(found[1]), int(found[2])) if found else (1, 0)


def probe_subgroups(context: cl.Context, device: cl.Device) -> Subgroups:
    """Subgroups that a device has, and that its compiler can use: a kernel that calls their functions is built."""
    has_feature = opencl_version(device) >= (2, 1) and ask(device, "max_num_sub_groups", 0) > 0
    if not has_feature and "cl_khr_subgroups" not in ask(device, "extensions", "").split():
        return Subgroups(0, BASE_LANGUAGE)
    group = (min(PROBE_GROUP, ask(device, "max_work_group_size", 1)),)
    question = cl.kernel_sub_group_info.MAX_SUB_GROUP_SIZE_FOR_NDRANGE
    for language, version in SUBGROUP_LANGUAGES:
        if opencl_version(device) < version:
            continue
        try:
            kernel = build(context, SUBGROUP_PROBE, [language, *BUILD_OPTIONS]).all_kernels()[0]
            size: Any = kernel.get_sub_group_info(device, question, group)
            return Subgroups(int(size), language)
        except cl.Error:
            continue
    return Subgroups(0, BASE_LANGUAGE)


def argument_type(argument: Any, real: np.dtype[Any]) -> np.dtype[Any] | None:
    """Type of a number or struct passed to a kernel; None for arrays, vectors and local memory."""
    if isinstance(argument, (int, np.integer)):
        return np.dtype(np.uint32)
    if isinstance(argument, float):
        return real
    known = isinstance(argument, np.generic) or (isinstance(argument, np.ndarray) and argument.dtype.names)
    return argument.dtype if known else None


def passed(kernel: str, argument: Any) -> Any:
    """A number, struct or vector as it is passed to a kernel: a negative integer by its 32 bits.

    Raises
    ------
    DeviceError
        If an integer has more bits.
    """
    if not isinstance(argument, (int, np.integer)):
        return argument
    if not -WORDS // 2 <= argument < WORDS:
        raise DeviceError(
            f"{kernel}: expected integers of 32 bits, found {argument}; use fewer Gaussians or a smaller image "
            "(--downscale)"
        )
    return int(argument) % WORDS
