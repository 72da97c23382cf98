"""OpenCL devices: context, kernels and buffers. Only this module, buffers, programs and ops import pyopencl."""

import os
import warnings
from collections.abc import Mapping
from functools import cached_property
from math import log2
from threading import RLock
from typing import Any
from weakref import ref

import numpy as np
import pyopencl as cl
import pyopencl.array
from numpy.typing import DTypeLike

from clsplat import constants
from clsplat.buffers import Buffers
from clsplat.errors import DeviceError, InputError
from clsplat.processors import name_processor, vector_width
from clsplat.programs import (
    WORDS,
    Subgroups,
    argument_type,
    ask,
    build,
    build_options,
    check_space,
    inline_includes,
    kernel_folder,
    passed,
    probe_subgroups,
)

POCL_HINT = "install one, for example the embedded CPU driver: pip install 'clsplat[pocl]'"

# Names in clsplat/constants.py of the constants that every program receives as -D.
MODEL_CONSTANTS = (
    "ALPHA_MIN",
    "LOG2_ALPHA_MIN",
    "EXPONENT_SLACK",
    "ALPHA_MAX",
    "TRANSMITTANCE_MIN",
    "BLUR",
    "COMPENSATION_MIN",
    "NEAR",
    "FRUSTUM_MARGIN",
    "QUAT_NORM2_MIN",
    "EXTENT_SLACK",
)

# Work-group size of kernels that require no particular one. A driver would choose it by the range's divisors, and
# PoCL compiles a kernel again for each size, that is, whenever the number of Gaussians changes.
GROUP = 64

# Variable that selects the variants of all stages, as --compositor does for one: auto (those for the device's type),
# cpu or gpu. Both compute the same on every device.
VARIANTS = "CLSPLAT_VARIANTS"


def list_devices() -> list[cl.Device]:
    """List all OpenCL devices, in the order of the platforms; an empty list if there is no driver."""
    try:
        platforms = cl.get_platforms()
    except cl.LogicError:  # the loader found no driver
        return []
    devices: list[cl.Device] = []
    for platform in platforms:
        try:
            devices += platform.get_devices()
        except cl.Error:  # a platform without devices raises this
            continue
    return devices


def device_label(device: cl.Device) -> str:
    """Platform and name of a device. ``--device`` takes a part of this text."""
    return f"{device.platform.name.strip()}: {device.name.strip()}"


def select_device(name: str | None = None) -> cl.Device:
    """Select the first device whose label contains `name`; without a name, that of PYOPENCL_CTX, else GPU before CPU.

    Raises
    ------
    DeviceError
        If there is no driver, no label contains `name`, or PYOPENCL_CTX selects no device.
    """
    devices = list_devices()
    if not devices:
        raise DeviceError(f"no OpenCL device found: {POCL_HINT}")
    if name is not None:
        matches = [d for d in devices if name.lower() in device_label(d).lower()]
        if not matches:
            found = ", ".join(device_label(d) for d in devices)
            raise DeviceError(f"--device {name!r}: expected part of one of these names: {found}")
        return matches[0]
    if os.environ.get("PYOPENCL_CTX"):
        try:
            return cl.create_some_context(interactive=False).devices[0]
        except (cl.Error, RuntimeError) as error:
            raise DeviceError(
                f"PYOPENCL_CTX={os.environ['PYOPENCL_CTX']!r} selects no OpenCL device: {error}"
            ) from error
    kinds = [cl.device_type.GPU, cl.device_type.ACCELERATOR, cl.device_type.CPU]
    return min(devices, key=lambda d: next((i for i, kind in enumerate(kinds) if d.type & kind), len(kinds)))


class Device:
    """An OpenCL device with its queue, programs and buffers.

    Several threads may render with one device: `launch`, and each function of `clsplat.ops.Launches`, holds `lock`.

    Parameters
    ----------
    cl_device : pyopencl.Device, optional
        Default: the result of `select_device`.
    real : float32 or float64
        Type of all real numbers on the device. float64 requires cl_khr_fp64 and is meant for tests.
    memory_limit : int, optional
        Largest total size of all buffers, those kept for reuse included, bytes. Default and maximum: device memory.
    model : mapping, optional
        Other values for constants of the rendering model, by their names in `MODEL_CONSTANTS`, to measure their
        effect. LOG2_ALPHA_MIN follows ALPHA_MIN. The twins keep the values of `clsplat.constants`.

    Attributes
    ----------
    memory_limit : int
        Largest total size of all buffers, bytes.
    model : dict
        Values of the constants of the rendering model.
    buffers : Buffers
        Buffers in the device's memory.
    lengths : dict
        Lengths of lists when they were last made, by name. The next lists are probably of similar lengths.
    lock : threading.RLock
        Held while kernels, which keep their arguments, and what is kept between launches are used.
    """

    def __init__(
        self,
        cl_device: cl.Device | None = None,
        real: DTypeLike = np.float32,
        memory_limit: int | None = None,
        model: Mapping[str, float] = {},
    ):
        if cl_device is not None and not hasattr(cl_device, "extensions"):
            raise InputError(f"cl_device: expected a device, such as select_device(name), found {cl_device!r:.60}")
        unknown = sorted(set(model) - set(MODEL_CONSTANTS))
        if unknown:
            raise InputError(f"model: expected names of {', '.join(MODEL_CONSTANTS)}, found {', '.join(unknown)}")
        self.model = {name: getattr(constants, name) for name in MODEL_CONSTANTS} | dict(model)
        self.model["LOG2_ALPHA_MIN"] = log2(self.model["ALPHA_MIN"])
        self.cl_device = cl_device if cl_device is not None else select_device()
        self.real: np.dtype[Any] = np.dtype(real)
        if self.real == np.float64 and "cl_khr_fp64" not in self.cl_device.extensions:
            raise DeviceError(f"{self.label}: expected a device with double precision (cl_khr_fp64) for float64")
        self._level = name_processor(self.cl_device)
        self.context = cl.Context([self.cl_device])
        self.queue = cl.CommandQueue(self.context)
        self.memory_limit = min(memory_limit or self.cl_device.global_mem_size, self.cl_device.global_mem_size)
        self.buffers = Buffers(self.queue, self.label, self.memory_limit)
        self.lengths: dict[str, int] = {}
        self.lock = RLock()
        self._constants: dict[str, tuple[bytes, cl.array.Array]] = {}
        self._programs: dict[tuple[Any, ...], cl.Program] = {}
        self._kernels: dict[tuple[Any, ...], cl.Kernel] = {}
        self._scratch: dict[str, tuple[tuple[int, Any], cl.array.Array]] = {}
        self._kept: dict[str, tuple[Any, ...]] = {}

    @property
    def label(self) -> str:
        """Platform and name of the device."""
        return device_label(self.cl_device)

    @property
    def memory(self) -> int:
        """Current total size of all buffers, bytes, including those kept for reuse."""
        return self.buffers.memory

    @property
    def memory_peak(self) -> int:
        """Largest total size of all buffers so far, bytes."""
        return self.buffers.peak

    @cached_property
    def is_cpu(self) -> bool:
        """Whether work-items run on CPU cores. Launches then use few work-items with large pieces of work.

        The variable CLSPLAT_VARIANTS overrides the type of the device.
        """
        variants = os.environ.get(VARIANTS) or "auto"
        if variants not in ("auto", "cpu", "gpu"):
            raise InputError(f"{VARIANTS}: expected auto, cpu or gpu, found {variants!r}")
        return variants == "cpu" if variants != "auto" else bool(self.cl_device.type & cl.device_type.CPU)

    @cached_property
    def _subgroups(self) -> Subgroups:
        return probe_subgroups(self.context, self.cl_device)

    @cached_property
    def subgroup_size(self) -> int:
        """Number of work-items in a subgroup; 0 without subgroups, or if the compiler cannot use them."""
        return self._subgroups.size

    @cached_property
    def largest_group(self) -> int:
        """Largest work-group that the device runs."""
        # Apple's device for CPUs names 1024, and refuses groups of several work-items that use barriers or local
        # memory (https://github.com/diku-dk/futhark/issues/1708, https://github.com/boostorg/compute/pull/610).
        if self.cl_device.platform.name.strip() == "Apple" and self.cl_device.type & cl.device_type.CPU:
            return 1
        sizes = ask(self.cl_device, "max_work_item_sizes", ())
        return max(1, min([ask(self.cl_device, "max_work_group_size", 1), *sizes[:1]]))

    def group(self, wanted: int) -> int:
        """Size of a work-group: `wanted`, halved until the device runs it."""
        while wanted > self.largest_group:
            wanted = (wanted + 1) // 2
        return wanted

    @cached_property
    def vector_width(self) -> int:
        """Number of floats in the vectors of kernels for CPUs: 8 or 16."""
        return vector_width(self.cl_device, self._level)

    def empty(self, what: str, shape: tuple[int, ...] | int, dtype: DTypeLike | None = None) -> cl.array.Array:
        """Uninitialised array of `dtype` (default: real). `what` names it in errors.

        Raises
        ------
        DeviceError
            If the array exceeds the device's largest buffer, its memory, or the limit.
        """
        shape = shape if isinstance(shape, tuple) else (int(shape),)
        return self.buffers.empty(what, shape, self.real if dtype is None else np.dtype(dtype))

    def zeros(self, what: str, shape: tuple[int, ...] | int, dtype: DTypeLike | None = None) -> cl.array.Array:
        """Array of zeros, as `empty`; the device writes them."""
        result = self.empty(what, shape, dtype)
        if result.nbytes:
            memory: Any = result.base_data
            cl.enqueue_fill_buffer(self.queue, memory, np.zeros(1, result.dtype), 0, result.nbytes)
        return result

    def scratch(self, what: str, size: int, layout: Any = None) -> cl.array.Array:
        """Flat array of `size` reals named `what`, kept between calls.

        It is filled with zeros when it is created, and again when `size` or `layout` changes.
        """
        known, result = self._scratch.pop(what, (None, None))
        if result is None or known != (size, layout):
            result = None  # frees the memory before more is allocated
            result = self.zeros(what, size)
        self._scratch[what] = (size, layout), result
        return result

    def upload(self, what: str, array: Any, dtype: DTypeLike | None = None) -> cl.array.Array:
        """Copy a host array to the device, converted to `dtype` (default: real)."""
        host = np.ascontiguousarray(array, dtype=self.real if dtype is None else dtype)
        result = self.empty(what, host.shape, host.dtype)
        result.set(host)
        return result

    def constant(self, what: str, values: Any, dtype: DTypeLike | None = None) -> cl.array.Array:
        """Numbers named `what` on the device (default: reals), uploaded only when they change: uploads wait for the
        queue."""
        host = np.ascontiguousarray(values, dtype=self.real if dtype is None else dtype)
        known, result = self._constants.get(what, (None, None))
        if result is None or known != host.tobytes():
            result = self.upload(what, host, host.dtype)
            self._constants[what] = host.tobytes(), result
        return result  # not from the dictionary, where another thread may have replaced it

    def keep(self, what: str, owner: tuple[cl.array.Array, ...], result: cl.array.Array) -> None:
        """Keep what was computed from the arrays of `owner`, for `kept`, until the first of them is freed."""
        whole = tuple(map(ref, owner[1:]))
        self._kept[what] = ref(owner[0], lambda _: self._kept.pop(what, None)), *whole, result

    def kept(self, what: str, owner: tuple[cl.array.Array, ...]) -> cl.array.Array | None:
        """The last array named `what` that was kept, if it was computed from these arrays."""
        *owners, result = self._kept.get(what, (None,))
        same = len(owners) == len(owner) and all(o() is array for o, array in zip(owners, owner, strict=True))
        return result if same else None

    def launch(
        self,
        stage: str,
        kernel: str,
        global_size: tuple[int, ...],
        arguments: list[Any],
        *,
        defines: dict[str, Any] | None = None,
        group: tuple[int, ...] | None = None,
    ) -> None:
        """Queue `kernel` of cl/`stage`.cl, built with `defines`, over `global_size` work-items.

        Arguments are device arrays, integers of Python or NumPy (passed as 32 bits), floats (passed as real), or
        vectors and structs of NumPy. A one-dimensional range without a `group` is rounded up to whole groups. Kernels
        launched this way ignore surplus work-items.
        """
        if group is None and len(global_size) == 1:
            group = (self.group(GROUP),)
            global_size = (-(-global_size[0] // group[0]) * group[0],)
        program = stage, frozenset((defines or {}).items())
        # A step passes 200 arguments: no calls for most of them.
        values: list[Any] = [
            a.data if isinstance(a, cl.array.Array) else a if type(a) is int and 0 <= a < WORDS else passed(kernel, a)
            for a in arguments
        ]
        with self.lock:
            run = self._kernels.get((kernel, program))
            if run is None:
                if program not in self._programs:
                    self._programs[program] = self.program(stage, defines or {})
                run = cl.Kernel(self._programs[program], kernel)
                # pyopencl passes a value whose type it does not know beforehand several times more slowly.
                run.set_scalar_arg_dtypes([argument_type(a, self.real) for a in arguments])
            run(self.queue, global_size, group, *values)
            self._kernels[kernel, program] = run  # not before its arguments have proved to fit

    def program(self, stage: str, defines: dict[str, Any]) -> cl.Program:
        """Build cl/`stage`.cl with `defines`, the model's constants and the device's real type.

        If a build with subgroups fails, a warning says so, and the device uses none. They change no result.
        """
        check_space(self.cl_device)
        source, values = inline_includes(f"{stage}.cl", kernel_folder()), self.model | defines
        if self._level:  # a key of PoCL's cache, which processors of other levels may share
            values["PROCESSOR"] = self._level
        if values.get("SUBGROUPS") != 1:
            return build(self.context, source, build_options(self.real, values))
        try:
            return build(self.context, source, build_options(self.real, values, self._subgroups.language))
        except cl.Error as error:
            result = build(self.context, source, build_options(self.real, values | {"SUBGROUPS": 0}))
            reason = str(error).strip().splitlines()[0]
            warnings.warn(f"{self.label}: cl/{stage}.cl is built without subgroups: {reason}", stacklevel=2)
            self.subgroup_size = 0
            return result
