"""NumPy dtypes of the structs that kernels take by value; cl/structs.h holds their OpenCL side."""

from typing import Any

import numpy as np

from clsplat.camera import Camera


def camera_struct(camera: Camera, real: Any) -> np.ndarray:
    """The `Camera` struct of cl/structs.h for a build whose reals are `real` (float32 or float64)."""
    dtype = np.dtype(
        [
            ("rotation", real, 9),
            ("translation", real, 3),
            ("position", real, 3),
            ("intrinsics", real, 4),
            ("size", "i4", 2),
        ]
    )
    struct = np.zeros((), dtype=dtype)
    struct["rotation"] = camera.viewmat[:3, :3].ravel()
    struct["translation"] = camera.viewmat[:3, 3]
    struct["position"] = camera.position
    struct["intrinsics"] = camera.fx, camera.fy, camera.cx, camera.cy
    struct["size"] = camera.width, camera.height
    return struct
