"""What `render` refuses, and the integers that it takes."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.config import RenderConfig
from clsplat.device import Device
from clsplat.errors import DeviceError, InputError
from clsplat.render import render
from clsplat.testing import synthetic_scene


def test_integers_of_numpy_are_those_of_python():
    gaussians, camera = synthetic_scene(30, sh_degree=1)
    device = Device()  # no kernel has been launched: the first launch decides on types
    other = replace(camera, width=np.int64(camera.width), height=np.int32(camera.height))
    found = render(gaussians, other, device=device, sh_degree=np.int64(1)).rgb
    np.testing.assert_array_equal(found, render(gaussians, camera, device=device, sh_degree=1).rgb)


def test_input_errors(device):
    gaussians, camera = synthetic_scene(3, sh_degree=1)
    with pytest.raises(InputError, match="sh_degree: expected 0 to 1"):
        render(gaussians, camera, sh_degree=2, device="reference")
    with pytest.raises(InputError, match="sh_degree"):
        render(gaussians, camera, sh_degree=-1, device="reference")
    with pytest.raises(InputError, match=r"sh_degree: expected an integer, found 1\.0"):
        render(gaussians, camera, sh_degree=1.0, device="reference")
    with pytest.raises(InputError, match="quats: expected shape"):
        render(replace(gaussians, quats=gaussians.quats[:2]), camera, device="reference")
    rendering = render(gaussians, camera, RenderConfig(), device)
    with pytest.raises(InputError, match=r"v_rgb: expected shape \(29, 37, 3\), found \(37, 29, 3\)"):
        rendering.backward(np.zeros((37, 29, 3)))
    with pytest.raises(InputError, match="v_depth: expected shape None"):
        rendering.backward(v_depth=np.zeros((29, 37)))


def test_image_too_large_for_the_device(device):
    gaussians, camera = synthetic_scene(3)
    with pytest.raises(DeviceError, match="needs a buffer of"):
        render(gaussians, replace(camera, width=10**6, height=10**6), RenderConfig(), device)
