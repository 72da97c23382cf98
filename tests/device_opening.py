"""Opening the device of a test."""

import pytest

from clsplat.device import Device
from clsplat.errors import DeviceError


def open_device(real):
    """A new device in a precision; what needs double precision is skipped on a device without it."""
    try:
        return Device(real=real)
    except DeviceError as error:
        if "double precision" not in str(error):
            raise
        pytest.skip(str(error))
