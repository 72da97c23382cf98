"""Launch of the stage project (cl/project.cl)."""

from typing import Any

import numpy as np
import pyopencl as cl

from clsplat.camera import Camera, pixel_rays
from clsplat.device import Device
from clsplat.gaussians import Gaussians
from clsplat.stages import AdamStep, AnyGrads, AnySplats, CameraGrads, RaySplats, Splats
from clsplat.structs import adam_struct, camera_struct, lens_define

GROUPED = 64
"""Gaussians per work-group of the backward kernels on a GPU, and of those that add up the gradient of the camera, in
76 to 140 bytes of local memory each."""

LANES = 8
"""Gaussians per work-item on a CPU, in the vectors of cl/lanes.h."""


def project_fwd(
    device: Device,
    gaussians: Gaussians,
    camera: Camera,
    sh_degree: int,
    *,
    antialiased: bool = False,
    channels: int = 3,
    rays: bool = False,
    gain: float = 1.0,
) -> AnySplats:
    """Project Gaussians into a camera.

    Parameters
    ----------
    gaussians : Gaussians of N >= 1 rows
    camera : Camera
    sh_degree : int
        Highest degree that is evaluated, at most the stored one.
    antialiased : bool
        True to compensate the opacity for the blur of the 2D covariance.
    channels : {3, 4}
        Number of colour channels. The fourth one is the depth.
    rays : bool
        True to evaluate Gaussians along rays instead of by an affine approximation; not for orthographic cameras,
        whose affine projection is exact.
    gain : float
        With `rays`, the outlines are those of opacities that are this factor larger, as by `dropout_fwd`.

    Returns
    -------
    Splats, or RaySplats with `rays`
    """
    n = len(gaussians)
    splats = Splats(
        device.empty("means2d", (n, 2)),
        device.empty("conics", (n, 3)),
        device.empty("depths", n),
        device.empty("extents", (n, 2)),
        device.empty("opacities", n),
        device.empty("colors", (n, channels)),
    )
    g = gaussians
    arguments = [n, camera_struct(camera, device.real), g.sh.shape[1], sh_degree, *g.arrays().values(), *splats]
    defines = _defines(device, camera, channels, antialiased, rays=rays)
    if not rays:
        _launch(device, "project_fwd", n, arguments, defines)
        return splats
    own_charts = camera.model != "pinhole"
    terms = device.empty("rays", (n, 17 if own_charts else 8))
    _launch(device, "project_fwd", n, [*arguments, terms, float(gain)], defines)
    directions = pixel_rays(camera) if own_charts else np.zeros((1, 1, 3))
    return RaySplats(*splats, terms, device.constant("directions", directions))


def join_rows(device: Device, first: Any, second: Any) -> Any:
    """Append rows to others, so that splats of two scenes are composited into one image.

    Parameters
    ----------
    first, second : (N, ...) and (M, ...)
        Arrays of reals with N and M >= 1 rows of the same shape, such as a field of `Splats`.

    Returns
    -------
    (N + M, ...)
    """
    result = device.empty(f"joined rows of {first.shape[1:]}", (first.shape[0] + second.shape[0], *first.shape[1:]))
    # Blocks of the pool are larger than their arrays.
    data: Any = result.data
    cl.enqueue_copy(device.queue, data, first.data, byte_count=first.nbytes)
    cl.enqueue_copy(device.queue, data, second.data, byte_count=second.nbytes, dst_offset=first.nbytes)
    return result


def project_disparities(device: Device, gaussians: Gaussians, camera: Camera, splats: AnySplats) -> Any:
    """Disparity of each Gaussian's maximum along the rays of pixels, as a linear function over the image.

    Parameters
    ----------
    gaussians, camera
        As given to `project_fwd`.
    splats : Splats
        Its result.

    Returns
    -------
    (N, 3)
        1/z at the splat's centre, in inverse world units, and its derivatives by x and y, per pixel; 0 for invisible
        Gaussians. It has no gradient, because only the order within a pixel depends on it.
    """
    n, g = len(gaussians), gaussians
    result = device.empty("disparities", (n, 3))
    arguments = [n, camera_struct(camera, device.real), g.means, g.log_scales, g.quats, splats.conics, splats.extents]
    defines = _defines(device, camera, splats.colors.shape[1], antialiased=False)
    _launch(device, "project_disparities", n, [*arguments, result], defines)
    return result


def project_bwd(
    device: Device,
    gaussians: Gaussians,
    camera: Camera,
    sh_degree: int,
    splats: AnySplats,
    v_splats: AnyGrads,
    *,
    antialiased: bool = False,
    camera_grad: bool = False,
) -> tuple[Gaussians, CameraGrads | None]:
    """Gradients with respect to the Gaussians and, optionally, the camera.

    Parameters
    ----------
    gaussians, camera, sh_degree, antialiased
        As given to `project_fwd`.
    splats : Splats or RaySplats
        Its result.
    v_splats : SplatGrads or RayGrads
        Gradients with respect to it.

    Returns
    -------
    v_gaussians : Gaussians
        Gradient for each field; 0 for invisible Gaussians.
    v_camera : CameraGrads or None
    """
    n, g = len(gaussians), gaussians
    empty: dict[str, Any] = {name: device.empty(f"v_{name}", array.shape) for name, array in g.arrays().items()}
    v = Gaussians(**empty)
    arguments = [n, camera_struct(camera, device.real), g.sh.shape[1], sh_degree, *g.arrays().values()]
    arguments += [splats.conics, splats.extents, splats.colors, *v_splats, *v.arrays().values()]
    rays = isinstance(splats, RaySplats)
    defines = _defines(device, camera, splats.colors.shape[1], antialiased, camera_grad, rays)
    return v, _backward(device, "project_bwd", n, arguments, defines)


def _defines(
    device: Device, camera: Camera, channels: int, antialiased: bool, camera_grad: bool = False, rays: bool = False
) -> dict[str, Any]:
    """Defines of the kernels for a camera. With those of a wide lens, a work-item takes one Gaussian (cl/lens.h)."""
    lanes = LANES if device.is_cpu and camera.model in ("pinhole", "orthographic") else 1
    # Groups of several work-items make PoCL keep the intermediate values of all of them in memory.
    group = device.group(GROUPED // lanes) if camera_grad or not device.is_cpu else 1
    return {
        "CHANNELS": channels,
        "ANTIALIASED": int(antialiased),
        "CAMERA_GRAD": int(camera_grad),
        "LENS": lens_define(camera, rays),
        "RAYS": int(rays),
        "LANES": lanes,
        "GROUP": group,
    }


def _launch(device: Device, kernel: str, n: int, arguments: list[Any], defines: dict[str, Any]) -> None:
    group = defines["GROUP"]
    groups = -(-n // (group * defines["LANES"]))
    device.launch("project", kernel, (groups * group,), arguments, defines=defines, group=(group,))


def _backward(
    device: Device, kernel: str, n: int, arguments: list[Any], defines: dict[str, Any]
) -> CameraGrads | None:
    """Launch a backward kernel. Returns the gradients with respect to the camera if `defines` request them."""
    if not defines["CAMERA_GRAD"]:
        _launch(device, kernel, n, arguments, defines)
        return None
    partial = device.empty("v_camera", (-(-n // (defines["GROUP"] * defines["LANES"])), 16))
    _launch(device, kernel, n, [*arguments, partial], defines)
    total = partial.get().astype(np.float64).sum(axis=0)
    v_viewmat = np.zeros((4, 4))
    v_viewmat[:3, :3] = total[:9].reshape(3, 3)
    v_viewmat[:3, 3] = total[9:12]
    return CameraGrads(v_viewmat, total[12:])


def project_bwd_adam(
    device: Device,
    gaussians: Gaussians,
    moments: tuple[Gaussians, Gaussians],
    camera: Camera,
    splats: AnySplats,
    v_splats: AnyGrads,
    step: AdamStep,
    *,
    antialiased: bool = False,
    camera_grad: bool = False,
) -> CameraGrads | None:
    """`project_bwd` and `adam_step` in one pass over the Gaussians, in place.

    Parameters not listed are those of the two functions.

    Parameters
    ----------
    moments : (first, second)
        Running means of the gradients and of their squares.
    step : AdamStep
        Its degree of the spherical harmonics must be that of `project_fwd`.

    Returns
    -------
    v_camera : CameraGrads or None
    """
    fields = [splats.conics, splats.extents, splats.colors, *v_splats]
    arrays = [array for part in (gaussians, *moments) for array in part.arrays().values()]
    arguments = [
        len(gaussians),
        camera_struct(camera, device.real),
        gaussians.sh.shape[1],
        step.sh_degree,
        adam_struct(step, device.real),
        *arrays,
        *fields,
    ]
    rays = isinstance(splats, RaySplats)
    defines = _defines(device, camera, splats.colors.shape[1], antialiased, camera_grad, rays)
    return _backward(device, "project_bwd_adam", len(gaussians), arguments, defines)
