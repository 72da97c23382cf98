"""3D Gaussian Splatting on any OpenCL device, without CUDA and without torch.

>>> import clsplat
>>> from clsplat.testing import synthetic_scene
>>> gaussians, camera = synthetic_scene(20)
>>> rendering = clsplat.render(gaussians, camera)  # device="reference" renders without OpenCL
>>> rendering.rgb.shape
(29, 37, 3)
>>> rendering.backward(rendering.rgb).gaussians.means.shape
(20, 3)
"""

from typing import TYPE_CHECKING, Any

from clsplat.camera import Camera
from clsplat.config import RenderConfig, TrainConfig
from clsplat.dataset import load_scene
from clsplat.errors import ClsplatError
from clsplat.formats import load_gaussians, save_gaussians
from clsplat.gaussians import Gaussians
from clsplat.rasterization import rasterization
from clsplat.render import Rendering, render, render_views
from clsplat.renderer import Renderer
from clsplat.scene import Scene, View
from clsplat.training.loop import train
from clsplat.training.preparation import prepare

if TYPE_CHECKING:
    from clsplat.device import Device

__all__ = [
    "Camera",
    "ClsplatError",
    "Device",
    "Gaussians",
    "RenderConfig",
    "Renderer",
    "Rendering",
    "Scene",
    "TrainConfig",
    "View",
    "load_gaussians",
    "load_scene",
    "prepare",
    "rasterization",
    "render",
    "render_views",
    "save_gaussians",
    "train",
]


def __getattr__(name: str) -> Any:
    # pyopencl takes longer to import than all of this package, and not every use needs it.
    if name == "Device":
        from clsplat.device import Device

        return Device
    raise AttributeError(f"module 'clsplat' has no attribute {name!r}")
