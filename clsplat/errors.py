"""Exceptions whose message is one sentence for the user.

A wrong value: "NAME: expected X, found Y; what to do". A failed action: "cannot read X: reason; what to do".
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager


class ClsplatError(Exception):
    """Base class of all errors that the command line prints as one sentence, without a traceback."""


class InputError(ClsplatError, ValueError):
    """An argument or a file cannot be used; the message names it."""


class DeviceError(ClsplatError, RuntimeError):
    """There is no usable OpenCL device, its limits are exceeded, or its driver failed."""


@contextmanager
def driver_errors() -> Iterator[None]:
    """Raise errors of the OpenCL driver in the block as DeviceError, such as a lost device or exhausted resources."""
    try:
        yield
    except Exception as error:
        cl = sys.modules.get("pyopencl")  # not imported: only clsplat.device and clsplat.ops may import it
        if cl is None or not isinstance(error, cl.Error):
            raise
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise DeviceError(f"the OpenCL driver failed: {reason}") from error
