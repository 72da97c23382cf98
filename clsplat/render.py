"""Rendering and its gradients: the stages in their order, on a device or by the float64 twins."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat import display, panorama, reference
from clsplat.camera import Camera
from clsplat.config import RenderConfig
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.scene import Color
from clsplat.stages import Bins, Dropout, Image, SplatGrads, Splats

if TYPE_CHECKING:
    from clsplat.device import Device

Array = NDArray[Any]


class Gradients(NamedTuple):
    """Gradients of a scalar with respect to what was rendered.

    gaussians: per field of `Gaussians`, pre-activation; means2d (N, 2): per pixel, the statistic of densification;
    viewmat (4, 4): each entry as an independent variable; intrinsics (4,): fx, fy, cx, cy; None if not asked for.
    """

    gaussians: Gaussians
    means2d: Any
    viewmat: NDArray[np.float64] | None
    intrinsics: NDArray[np.float64] | None


def stage_functions(device: "Device | None") -> Any:
    """Namespace of the stage functions: `clsplat.ops` bound to `device`, or `clsplat.reference` for None."""
    if device is None:
        return reference
    from clsplat import ops

    return SimpleNamespace(**{name: partial(getattr(ops, name), device) for name in ops.__all__})


@dataclass(frozen=True)
class Pass:
    """A forward pass: what `backward` needs of it. Arrays live where the stages ran.

    disparities: of the splats, where pixels are sorted.
    """

    gaussians: Gaussians
    camera: Camera
    config: RenderConfig
    sh_degree: int
    splats: Splats
    bins: Bins
    image: Image
    disparities: Any = None
    dropout: Dropout | None = None


def forward(
    device: "Device | None",
    gaussians: Gaussians,
    camera: Camera,
    config: RenderConfig,
    background: Any,
    sh_degree: int,
    *,
    gradients: bool = True,
    dropout: Dropout | None = None,
) -> Pass:
    """Run the stages from Gaussians to an image.

    Parameters
    ----------
    device : Device or None
        None runs the twins.
    gaussians : Gaussians of N >= 1 rows, arrays of the device
    background : (C,) array on the host
        Its length is the number of channels: 3 for RGB, 4 to composite the depth too.
    gradients : bool
        Whether `backward` will follow: its lists of intersections are left out otherwise.
    dropout : Dropout, optional
        Which splats are left out while training.
    """
    stage = stage_functions(device)
    if config.near is not None:
        camera = replace(camera, near=config.near)
    antialiased = config.mode == "antialiased"
    splats = stage.project_fwd(gaussians, camera, sh_degree, antialiased=antialiased, channels=len(background))
    if dropout:
        stage.dropout_fwd(splats, dropout)
    # The twins work splat by splat and gain nothing from tiles.
    tile_size = max(camera.width, camera.height) if device is None else config.tile_size
    by_pixel = config.sort == "pixel"
    scheme = "auto" if by_pixel else config.sort
    bins = stage.bin_splats(splats, camera.width, camera.height, tile_size, gradients=gradients, scheme=scheme)
    disparities = stage.project_disparities(gaussians, camera, splats) if by_pixel else None
    image = stage.composite_fwd(splats, bins, background, compositor=config.compositor, disparities=disparities)
    return Pass(gaussians, camera, config, sh_degree, splats, bins, image, disparities, dropout)


def backward_to_splats(device: "Device | None", run: Pass, v_image: Image) -> SplatGrads:
    """The first half of `backward`: gradients with respect to the splats."""
    stage = stage_functions(device)
    v_splats: SplatGrads = stage.composite_bwd(
        run.splats, run.bins, run.image, v_image, compositor=run.config.compositor, disparities=run.disparities
    )
    if run.dropout:
        stage.dropout_bwd(v_splats, run.dropout)
    return v_splats


def backward(device: "Device | None", run: Pass, v_image: Image, *, camera_grad: bool = False) -> Gradients:
    """Gradients of a forward pass, from the gradients with respect to its image and alpha."""
    v_splats = backward_to_splats(device, run, v_image)
    v_gaussians, v_camera = stage_functions(device).project_bwd(
        run.gaussians,
        run.camera,
        run.sh_degree,
        run.splats,
        v_splats,
        antialiased=run.config.mode == "antialiased",
        camera_grad=camera_grad,
    )
    return Gradients(v_gaussians, v_splats.means2d, *(v_camera or (None, None)))


def upload(device: "Device | None", gaussians: Gaussians) -> Gaussians:
    """The Gaussians on the device; as float64 for None."""
    if device is None:
        return gaussians.astype(np.float64)
    arrays: dict[str, Any] = {name: device.upload(name, array) for name, array in gaussians.arrays().items()}
    return Gaussians(**arrays)


def download(array: Any) -> Array:
    """A device array on the host; a NumPy array as it is."""
    return array if isinstance(array, np.ndarray) else array.get()


def fetch(gaussians: Gaussians) -> Gaussians:
    """Gaussians of the device on the host; those of the host as they are."""
    return Gaussians(**{name: download(array) for name, array in gaussians.arrays().items()})


class Rendering:
    """A rendered image that knows how to differentiate itself; made by `render` and, without that, `render_views`.

    Attributes
    ----------
    rgb : (H, W, 3)
        Colours, background included; not clamped above.
    alpha : (H, W)
        1 - transmittance.
    depth : (H, W) or None
        Expected depth: the mean of the splats' depths in world units (z; distances for a fisheye and a panorama),
        weighted as the colours are; 0 where alpha is 0. None unless asked for.
    """

    def __init__(self, device: "Device | None", run: Pass | None, gaussians: Gaussians, image: Array, alpha: Array):
        self._device, self._run, self._gaussians = device, run, gaussians
        self.rgb, self.alpha = image[:, :, :3], alpha
        self.depth: Array | None = None
        if image.shape[2] == 4:
            self.depth = np.divide(image[:, :, 3], alpha, out=np.zeros_like(alpha), where=alpha > 0)

    def _repr_png_(self) -> bytes:
        return display.png(self.rgb)

    def backward(
        self,
        v_rgb: Array | None = None,
        v_alpha: Array | None = None,
        v_depth: Array | None = None,
        *,
        viewmat_grad: bool = False,
        intrinsics_grad: bool = False,
    ) -> Gradients:
        """Gradients of a scalar with respect to the Gaussians and the camera.

        Parameters
        ----------
        v_rgb, v_alpha, v_depth : arrays of the shapes of rgb, alpha and depth, optional
            The scalar's gradients with respect to them; left out: 0.
        viewmat_grad, intrinsics_grad : bool
            Also return the gradient with respect to the viewmat, and to fx, fy, cx, cy.

        Returns
        -------
        Gradients
            NumPy arrays.

        Raises
        ------
        InputError
            If a shape does not fit, v_depth is given though no depth was rendered, or it was rendered without
            gradients.
        """
        if self._run is None and len(self._gaussians):
            raise InputError(
                "gradients: expected a rendering made with gradients=True of a camera that is not equirectangular, "
                "found another"
            )
        for name, v, shape in (
            ("v_rgb", v_rgb, self.rgb.shape),
            ("v_alpha", v_alpha, self.alpha.shape),
            ("v_depth", v_depth, None if self.depth is None else self.depth.shape),
        ):
            if v is not None and np.shape(v) != shape:
                raise InputError(f"{name}: expected shape {shape}, found {np.shape(v)}")
        if self._run is None:
            zeros = Gaussians(**{k: np.zeros_like(a) for k, a in self._gaussians.arrays().items()})
            v_viewmat, v_intrinsics = np.zeros((4, 4)), np.zeros(4)
            result = Gradients(zeros, np.zeros((0, 2)), v_viewmat, v_intrinsics)
            return _asked_for(result, viewmat_grad, intrinsics_grad)
        # Filled on the host: its dtype is that of the image.
        v_image = np.zeros((*self.alpha.shape, 3 if self.depth is None else 4), dtype=self.alpha.dtype)
        v_total_alpha = np.zeros_like(self.alpha) if v_alpha is None else np.array(v_alpha, dtype=self.alpha.dtype)
        if v_rgb is not None:
            v_image[:, :, :3] = v_rgb
        if v_depth is not None and self.depth is not None:
            v_image[:, :, 3] = np.divide(v_depth, self.alpha, out=np.zeros_like(self.alpha), where=self.alpha > 0)
            v_total_alpha -= v_image[:, :, 3] * self.depth
        v_run = Image(v_image, v_total_alpha)
        if self._device is not None:
            v_run = Image(*(self._device.upload("v_image", a) for a in v_run))
        result = backward(self._device, self._run, v_run, camera_grad=viewmat_grad or intrinsics_grad)
        result = result._replace(gaussians=fetch(result.gaussians), means2d=download(result.means2d))
        return _asked_for(result, viewmat_grad, intrinsics_grad)


def _asked_for(gradients: Gradients, viewmat: bool, intrinsics: bool) -> Gradients:
    return gradients._replace(
        viewmat=gradients.viewmat if viewmat else None, intrinsics=gradients.intrinsics if intrinsics else None
    )


def render(
    gaussians: Gaussians,
    camera: Camera,
    config: RenderConfig = RenderConfig(),
    device: "Device | None" = None,
    *,
    background: Color = (0.0, 0.0, 0.0),
    sh_degree: int | None = None,
    depth: bool = False,
    gradients: bool = True,
) -> Rendering:
    """Render Gaussians (Kerbl et al. 2023).

    Parameters
    ----------
    gaussians : Gaussians
        Pre-activation, on the host.
    camera : Camera
        An equirectangular one is resampled from six faces of a cube, and has no gradients.
    config : RenderConfig
    device : Device, optional
        None renders with the float64 twins: exact and slow.
    background : (3,) floats
        RGB behind the Gaussians.
    sh_degree : int, optional
        Highest degree of the spherical harmonics evaluated; default: all that are stored.
    depth : bool
        Composite the expected depth too.
    gradients : bool
        Keep on the device what `Rendering.backward` needs. False is for pictures alone: faster, and nothing stays.

    Returns
    -------
    Rendering

    Raises
    ------
    InputError
        If the Gaussians' shapes do not fit each other or sh_degree exceeds what is stored.
    DeviceError
        If a buffer exceeds the device's limits.
    """
    behind, degree = _checked(gaussians, background, sh_degree, depth)
    return next(_renderings(gaussians, [camera], config, device, behind, degree, gradients=gradients))


def render_views(
    gaussians: Gaussians,
    cameras: Iterable[Camera],
    config: RenderConfig = RenderConfig(),
    device: "Device | None" = None,
    *,
    background: Color = (0.0, 0.0, 0.0),
    sh_degree: int | None = None,
    depth: bool = False,
) -> Iterator[Rendering]:
    """Render one image after the other, forward only; the Gaussians are uploaded once.

    Parameters
    ----------
    cameras : iterable of Camera
        Of any sizes; each is asked for when its image is.
    gaussians, config, device, background, sh_degree, depth
        As given to `render`, which has the errors too.

    Yields
    ------
    Rendering
        Per camera; without gradients.
    """
    behind, degree = _checked(gaussians, background, sh_degree, depth)
    return _renderings(gaussians, cameras, config, device, behind, degree, gradients=False)


def _checked(gaussians: Gaussians, background: Color, sh_degree: int | None, depth: bool) -> tuple[Array, int]:
    """What is behind each channel, and the degree that is evaluated."""
    gaussians.validate()
    degree = gaussians.sh_degree if sh_degree is None else sh_degree
    if not 0 <= degree <= gaussians.sh_degree:
        raise InputError(f"sh_degree: expected 0 to {gaussians.sh_degree} (what is stored), found {degree}")
    return np.array([*background, 0.0] if depth else background), degree


def _renderings(
    gaussians: Gaussians,
    cameras: Iterable[Camera],
    config: RenderConfig,
    device: "Device | None",
    background: Array,
    sh_degree: int,
    *,
    gradients: bool,
) -> Iterator[Rendering]:
    uploaded = upload(device, gaussians) if len(gaussians) else gaussians
    for camera in cameras:
        run, image, alpha = _rendered(device, uploaded, camera, config, background, sh_degree, gradients=gradients)
        yield Rendering(device, run if gradients else None, gaussians, image, alpha)


def _rendered(
    device: "Device | None",
    gaussians: Gaussians,
    camera: Camera,
    config: RenderConfig,
    background: Array,
    sh_degree: int,
    *,
    gradients: bool,
) -> tuple[Pass | None, Array, Array]:
    """The pass, where there is one, its image and its alpha, on the host."""
    if len(gaussians) == 0:
        dtype = np.float64 if device is None else device.real
        image: Array = np.broadcast_to(background.astype(dtype), (camera.height, camera.width, len(background)))
        return None, image, np.zeros(image.shape[:2], dtype)
    if camera.model == "equirectangular":
        layers = []
        for face in panorama.faces(camera):
            _, image, alpha = _rendered(device, gaussians, face, config, background, sh_degree, gradients=False)
            if len(background) == 4:  # from depths to distances
                u, v = np.meshgrid(np.arange(face.width) + 0.5, np.arange(face.height) + 0.5)
                image = image.copy()
                image[:, :, 3] /= face.rays(u, v)[:, :, 2]
            layers.append(np.concatenate([image, alpha[:, :, None]], axis=2))
        whole = panorama.assemble(camera, layers)
        return None, whole[:, :, :-1], whole[:, :, -1]
    run = forward(device, gaussians, camera, config, background, sh_degree, gradients=gradients)
    return run, download(run.image.image), download(run.image.alpha)
