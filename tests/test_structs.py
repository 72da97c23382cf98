"""Structs: the same bytes on both sides."""

import shutil

import numpy as np

import clsplat.device
import clsplat.programs
from clsplat.camera import Camera
from clsplat.structs import camera_struct

# Reads every field by its name, and the size of the whole.
ECHO = """
#include "common.h"
#include "structs.h"
__kernel void echo(const Camera c, const uint bytes, __global real *out, __global uint *size) {
    for (int i = 0; i < 9; ++i)
        out[i] = c.rotation[i];
    for (int i = 0; i < 3; ++i) {
        out[9 + i] = c.translation[i];
        out[12 + i] = c.position[i];
    }
    out[15] = c.fx;
    out[16] = c.fy;
    out[17] = c.cx;
    out[18] = c.cy;
    out[19] = c.near;
    out[20] = c.width;
    out[21] = c.height;
    *size = sizeof(Camera) == bytes;
}
"""


def test_camera(any_device, tmp_path, monkeypatch):
    shutil.copytree(clsplat.programs.kernel_folder(), tmp_path / "cl")
    (tmp_path / "cl" / "echo.cl").write_text(ECHO)
    monkeypatch.setattr(clsplat.device, "kernel_folder", lambda: tmp_path / "cl")
    viewmat = Camera.look_at((1, 2, 3), (0, 0.5, 0), (0, 0, 1), 1, 1, 1).viewmat
    camera = Camera(viewmat, 101.5, 102.25, 31, 23, 64, 48, near=0.25)
    struct = camera_struct(camera, any_device.real)
    out, same = any_device.empty("out", 22), any_device.empty("size", 1, np.uint32)
    any_device.launch("echo", "echo", (1,), [struct, struct.nbytes, out, same])
    assert same.get()[0] == 1, f"sizeof(Camera) is not {struct.nbytes}, the dtype's size"
    expected = [*viewmat[:3, :3].ravel(), *viewmat[:3, 3], *camera.position, 101.5, 102.25, 31, 23, 0.25, 64, 48]
    np.testing.assert_array_equal(out.get(), np.array(expected, any_device.real))
