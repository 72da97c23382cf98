"""`rasterization`: gsplat's function of that name on OpenCL, with its gradients."""

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.camera import Camera
from clsplat.constants import BLUR
from clsplat.errors import DeviceError, InputError
from clsplat.gaussians import Gaussians
from clsplat.raster_arguments import (
    RenderMode,
    arrays,
    behind_of,
    cameras_of,
    check_choices,
    gaussians_of,
    moderated,
    rows_of,
    values_of,
)
from clsplat.raster_gradients import Rasterization, RasterPass, RasterPasses
from clsplat.renderer import Renderer, download
from clsplat.stages import AnySplats
from clsplat.surface import surface_of

if TYPE_CHECKING:
    from clsplat.device import Device

_BLURRED: "WeakKeyDictionary[Device, Device]" = WeakKeyDictionary()
"""The last result of `_blurred` for each device, as long as that lives: it holds the compiled kernels."""


def rasterization(
    means: ArrayLike,
    quats: ArrayLike,
    scales: ArrayLike,
    opacities: ArrayLike,
    colors: ArrayLike,
    viewmats: ArrayLike,
    Ks: ArrayLike,
    width: int,
    height: int,
    *,
    sh_degree: int | None = None,
    tile_size: Literal[8, 16, 32] = 16,
    backgrounds: ArrayLike | None = None,
    render_mode: RenderMode = "RGB",
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
    camera_model: Literal["pinhole", "ortho", "fisheye"] = "pinhole",
    radial_coeffs: ArrayLike | None = None,
    near_plane: float | None = None,
    eps2d: float = BLUR,
    radius_clip: float = 0.0,
    gradients: bool = False,
    normals: bool = False,
    device: "Device | Literal['reference'] | None" = None,
) -> Rasterization:
    """Render a batch of cameras from activated parameters, with gsplat's arguments.

    Parameters
    ----------
    means : (N, 3)
        Centres, world units.
    quats : (N, 4)
        wxyz, of any norm.
    scales : (N, 3)
        Standard deviations (activated), world units.
    opacities : (N,)
        In [0, 1] (activated).
    colors : (N, D) or (C, N, D), or (N, K, 3) with sh_degree
        Values of D channels, 1 to 32, per Gaussian (and camera), or coefficients of spherical harmonics.
    viewmats : (C, 4, 4)
        World to camera.
    Ks : (C, 3, 3)
        Intrinsic matrices without skew, px.
    width, height : int
        Image size, px.
    sh_degree : int, optional
        Degree up to which `colors` are evaluated as spherical harmonics; None takes them as they are.
    tile_size : {8, 16, 32}
        Edge of a tile, px.
    backgrounds : (C, D), optional
        Behind the Gaussians; default 0. No background is put behind the depth.
    render_mode : {"RGB", "D", "ED", "RGB+D", "RGB+ED"}
        Colours, accumulated depth, expected depth (accumulated depth / alpha), or colours and one of them.
    rasterize_mode : {"classic", "antialiased"}
        antialiased compensates opacities for the dilation of small splats.
    camera_model : {"pinhole", "ortho", "fisheye"}
        As `Camera` defines them.
    radial_coeffs : (C, 4), optional
        k1 to k4 of fisheyes; default 0.
    near_plane : float, optional
        Depth below which nothing is drawn, world units; default: 0.01, as in gsplat.
    eps2d : float
        Variance that is added to the splats' 2D covariances, px^2. The reference has the default only.
    radius_clip : float
        Half width, px, up to which splats are left out.
    gradients : bool
        Whether `Rasterization.backward` follows. True keeps its inputs on the device.
    normals : bool
        Whether meta also holds the surface: normals and median_depths, which have no gradient.
    device : Device, "reference" or None
        None takes the default OpenCL device; "reference" the float64 twins, slowly.

    Returns
    -------
    Rasterization
        The tuple (render, alpha, meta), with a method `backward`. render (C, H, W, X) has X channels: D, 1 or D + 1,
        the depth last. alpha is (C, H, W, 1). meta is a dict of means2d (C, N, 2), conics (C, N, 3), depths (C, N),
        opacities (C, N) with the compensation, radii (C, N, 2) px as integers, 0 for splats that are not visible,
        tiles_per_gauss (C, N), and width, height, tile_size, n_cameras; with `normals`, normals (C, H, W, 3), in the
        world, and median_depths (C, H, W), as `clsplat.surface.Surface` has them.

    Raises
    ------
    InputError
        If shapes do not fit each other, a number is out of range or not finite, or an array of another library is not
        in the memory of the host; the message names the argument.
    DeviceError
        If there is no OpenCL device, a buffer exceeds its limits, or the pixels of a tile exceed the local memory,
        which holds them for the gradients.
    """
    check_choices(
        tile_size=tile_size, render_mode=render_mode, rasterize_mode=rasterize_mode, camera_model=camera_model
    )
    means, quats, scales, opacities = arrays(means=means, quats=quats, scales=scales, opacities=opacities)
    colors, viewmats, Ks = arrays(colors=colors, viewmats=viewmats, Ks=Ks)
    n, count = rows_of("means", means, (3,)), rows_of("viewmats", viewmats, (4, 4))
    if n == 0 or count == 0:
        raise InputError(f"means, viewmats: expected at least one Gaussian and one camera, found {n} and {count}")
    shared = colors.ndim == 2
    if sh_degree is None:
        colors = values_of(np.broadcast_to(colors, (count, *colors.shape)) if shared else colors, (count, n))
    gaussians = gaussians_of(means, scales, quats, opacities, colors, sh_degree)
    cameras = cameras_of(viewmats, Ks, (width, height), camera_model, radial_coeffs, near_plane)
    channels = colors.shape[2] if sh_degree is None else 3
    behind = behind_of(backgrounds, (count, channels))

    renderer = _renderer(device, eps2d)
    if gradients:
        _check_local(renderer.device, tile_size, channels * ("RGB" in render_mode) + ("D" in render_mode))
    moderate = replace(gaussians, quats=moderated(gaussians.quats))
    placed, antialiased = renderer.place(moderate), rasterize_mode == "antialiased"
    parts: list[tuple[RasterPass, dict[str, Any]]] = []
    for i, camera in enumerate(cameras):
        splats = renderer.stages.project_fwd(placed, camera, sh_degree or 0, antialiased=antialiased, channels=4)
        splats = _clipped(renderer, splats, radius_clip)
        values = colors[i] if sh_degree is None else download(splats.colors)[:, :3]
        run, meta = _composited(renderer, splats, camera, values, behind[i], (render_mode, tile_size, gradients))
        parts.append((run, meta | _surface(renderer, moderate, run) if normals else meta))
    passes = [run for run, _ in parts]
    stacked: dict[str, Any] = {name: np.stack([meta[name] for _, meta in parts]) for name in parts[0][1]}
    stacked |= {"width": width, "height": height, "tile_size": tile_size, "n_cameras": count}
    result = Rasterization(np.stack([run.render for run in passes]), np.stack([run.alpha for run in passes]), stacked)
    if gradients:
        result.remember(RasterPasses(renderer, placed, gaussians, passes, sh_degree, antialiased, shared))
    return result


def _surface(renderer: Renderer, gaussians: Gaussians, run: RasterPass) -> dict[str, Any]:
    """Normals and median depths of a camera, as a part of meta."""
    ids = download(renderer.stages.median_splats(run.colored, run.bins))
    surface = surface_of(gaussians, run.camera, ids)
    return {"normals": surface.normals, "median_depths": surface.depth}


def _clipped(renderer: Renderer, splats: AnySplats, radius_clip: float) -> AnySplats:
    """The splats without those whose half widths are at most `radius_clip`, px."""
    if not radius_clip >= 0:
        raise InputError(f"radius_clip: expected a number, 0 or more, found {radius_clip}")
    if radius_clip == 0:
        return splats
    extents = download(splats.extents)
    kept = (extents.max(axis=1) > radius_clip)[:, None]
    return splats._replace(extents=renderer.upload("extents", extents * kept))


def _renderer(device: "Device | Literal['reference'] | None", eps2d: float) -> Renderer:
    """A renderer that adds `eps2d` to the 2D covariances."""
    renderer = Renderer(device)
    return renderer if eps2d == BLUR else Renderer(_blurred(renderer.device, eps2d))


def _blurred(device: "Device | None", eps2d: float) -> "Device":
    """The same device with kernels that add `eps2d` to the 2D covariances."""
    if device is None or not 0 < eps2d < float("inf"):
        raise InputError(f"eps2d: expected a number above 0, on the reference {BLUR}, found {eps2d}")
    if device not in _BLURRED or _BLURRED[device].model["BLUR"] != eps2d:
        from clsplat.device import Device

        model = device.model | {"BLUR": float(eps2d)}
        _BLURRED[device] = Device(device.cl_device, device.real, device.memory_limit, model)
    return _BLURRED[device]


def _check_local(device: "Device | None", tile_size: int, channels: int) -> None:
    """Raise a DeviceError if the local memory of a GPU does not hold what `backward` keeps of a tile's pixels."""
    if device is None or device.is_cpu:
        return
    needed = tile_size**2 * (2 + channels) * device.real.itemsize + 4  # cl/composite_gpu.cl: composite_bwd
    if needed > device.cl_device.local_mem_size:
        raise DeviceError(
            f"tile_size: gradients of {channels} channels in tiles of {tile_size} px need {needed} bytes of local "
            f"memory, but {device.label} has {device.cl_device.local_mem_size}; use smaller tiles or fewer channels"
        )


def _composited(
    renderer: Renderer,
    splats: AnySplats,
    camera: Camera,
    values: NDArray[Any],
    behind: NDArray[Any],
    options: tuple[RenderMode, int, bool],
) -> tuple[RasterPass, dict[str, Any]]:
    """The pass of one camera from the values (N, D) of the splats, and its part of meta.

    options: render mode, tile size, and whether gradients follow.
    """
    render_mode, tile_size, gradients = options
    edge = max(camera.width, camera.height) if renderer.device is None else tile_size
    bins = renderer.stages.bin_splats(splats, camera.width, camera.height, edge, gradients=gradients)
    channels = values.shape[1]
    values = _with_depth(values, download(splats.depths), render_mode)
    background = np.zeros(values.shape[1])
    if "RGB" in render_mode:
        background[: len(behind)] = behind
    colored = splats._replace(colors=renderer.upload("colors", values))
    image = renderer.stages.composite_fwd(colored, bins, background)
    render, alpha = np.array(download(image.rgb)), download(image.alpha)[:, :, None]
    if "ED" in render_mode:
        render[:, :, -1:] = np.divide(render[:, :, -1:], alpha, out=np.zeros_like(alpha), where=alpha > 0)
    meta = {name: download(getattr(splats, name)) for name in ("means2d", "conics", "depths", "opacities")}
    # The largest number of single precision that fits.
    meta["radii"] = np.ceil(np.minimum(download(splats.extents), np.float32(2**31 - 128))).astype(np.int32)
    meta["tiles_per_gauss"] = np.bincount(download(bins.gauss_ids), minlength=len(meta["depths"]))
    return RasterPass(camera, splats, colored, bins, image, render, alpha, background, render_mode, channels), meta


def _with_depth(values: NDArray[Any], depths: NDArray[Any], render_mode: str) -> NDArray[Any]:
    if render_mode == "RGB":
        return values
    if render_mode in ("D", "ED"):
        return depths[:, None]
    return np.concatenate([values, depths[:, None]], axis=1)
