"""Exceptions whose message is one sentence for the user: what was expected, what was found, what to do."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager


class ClsplatError(Exception):
    """Base of every error that the command line prints as one sentence, without a traceback."""


class InputError(ClsplatError, ValueError):
    """An argument or a file that cannot be used as it is; the message names it."""


class DeviceError(ClsplatError, RuntimeError):
    """No usable OpenCL device, or one whose limits a buffer exceeds."""


@contextmanager
def driver_errors() -> Iterator[None]:
    """Errors of an OpenCL driver, such as a device that is lost or out of resources in the middle, as DeviceError."""
    try:
        yield
    except Exception as error:
        cl = sys.modules.get("pyopencl")  # only clsplat.device and clsplat.ops import it, and nothing fails before
        if cl is None or not isinstance(error, cl.Error):
            raise
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise DeviceError(f"the OpenCL driver failed: {reason}") from error
