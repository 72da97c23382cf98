"""Fixtures: OpenCL devices of both precisions, one that poses as a GPU, variants of compositing, a folder of kernels,
and the data beside the project."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from device_opening import open_device
from hypothesis import HealthCheck, settings

import clsplat.device
import clsplat.programs
from clsplat.device import Device
from clsplat.programs import kernel_folder

# No clock and no chance in the default run: the same cases each time, however slow the machine. `make fuzz-cases`
# draws new ones.
EVERYWHERE = {"deadline": None, "database": None, "suppress_health_check": list(HealthCheck), "print_blob": True}
settings.register_profile("default", derandomize=True, max_examples=60, **EVERYWHERE)
settings.register_profile("fuzz", max_examples=int(os.environ.get("CLSPLAT_FUZZ", 6000)), **EVERYWHERE)
settings.load_profile("default")

PROJECT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def device():
    """The device in float32, as users run it."""
    return Device()


@pytest.fixture(scope="session")
def device64():
    """The device in float64, in which gradients are proved."""
    return open_device(np.float64)


@pytest.fixture(scope="session", params=["as it is", "as a GPU"])
def configured_device(request):
    """The float32 device, and one that the launches configure like a GPU, whatever it is."""
    device = Device()
    if request.param == "as a GPU":
        device.is_cpu = False  # shadows the cached property
    return device


@pytest.fixture(scope="session", params=["float64", "float32"])
def any_device(request):
    """The device in both precisions."""
    return request.getfixturevalue("device64" if request.param == "float64" else "device")


@pytest.fixture(scope="session")
def project():
    """The project's root."""
    return PROJECT


@pytest.fixture(scope="session")
def shared():
    """Real scenes and gold renders, beside the project and not part of it."""
    folder = PROJECT.parent / "shared"
    if not folder.is_dir():
        pytest.skip("../shared, the scenes and gold renders beside the project, is missing")
    return folder


@pytest.fixture(params=["cpu", "gpu"])
def compositor(request):
    """Kernel variant; each runs on every device."""
    return request.param


@pytest.fixture
def kernels(tmp_path, monkeypatch):
    """A folder of sources of our own in the place of cl/."""
    shutil.copytree(kernel_folder(), tmp_path / "cl")
    monkeypatch.setattr(clsplat.device, "kernel_folder", lambda: tmp_path / "cl")
    return tmp_path / "cl"
