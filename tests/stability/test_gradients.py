"""Clamped alpha: the gradient is that of the image, and other constants in the forward pass are detected."""

import numpy as np

from clsplat.bench.stability.gradients import OTHER_ALPHA_MAX, mismatch
from clsplat.device import Device


def test_gradients_are_those_of_the_image_where_alpha_saturates(device64):
    """OpenSplat clamps alpha at 0.999 forward and at 0.99 backward, so its gradients belong to another image."""
    other = Device(device64.cl_device, real=np.float64, model={"ALPHA_MAX": OTHER_ALPHA_MAX})
    assert mismatch(device64, device64) < 1e-5
    assert mismatch(other, device64) > 0.01
