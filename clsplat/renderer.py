"""The renderer: the stages in their order, forward and backward, on a device or in NumPy."""

from dataclasses import dataclass, replace
from functools import cache
from threading import Lock
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat import reference
from clsplat.camera import Camera
from clsplat.config import RenderConfig
from clsplat.constants import GPU_TILE, TILE, WIDE_TILE
from clsplat.errors import DeviceError, InputError
from clsplat.gaussians import Gaussians
from clsplat.ranges import check
from clsplat.scene import Color, check_color
from clsplat.stages import AnyGrads, AnySplats, Bins, Dropout, Image, Stages

if TYPE_CHECKING:
    from clsplat.device import Device

Array = NDArray[Any]

BLACK: Color = (0.0, 0.0, 0.0)

_OPENING = Lock()


class Gradients(NamedTuple):
    """Gradients of a scalar with respect to what was rendered.

    gaussians: one per field of `Gaussians`, pre-activation; means2d (N, 2): per pixel, the statistic of
    densification; viewmat (4, 4): each entry as an independent variable; intrinsics (4,): fx, fy, cx, cy. The last
    two are None unless they were requested.
    """

    gaussians: Gaussians
    means2d: Any
    viewmat: NDArray[np.float64] | None
    intrinsics: NDArray[np.float64] | None


@dataclass(frozen=True)
class Pass:
    """Results of a forward pass that its gradients need. Arrays are where the stages ran.

    splats: those of the Gaussians. drawn: all that were composited, those of the Gaussians before those of the
    backdrop, if there is one. disparities: those of all, where each pixel sorts them; otherwise None. inverse:
    whether the fourth channel is the inverse depth.
    """

    gaussians: Gaussians
    camera: Camera
    sh_degree: int
    splats: AnySplats
    drawn: AnySplats
    bins: Bins
    image: Image
    disparities: Any = None
    dropout: Dropout | None = None
    inverse: bool = False


class Renderer:
    """A device, settings and a background with which Gaussians are rendered; threads take turns, stage by stage.

    Parameters
    ----------
    device : Device, "reference" or None
        None takes `default_device`. "reference" renders in float64 NumPy: exact, slow, and without OpenCL.
    config : RenderConfig
    background : (3,) floats
        RGB behind the Gaussians.
    backdrop : Gaussians, optional
        Gaussians that are drawn in every image in addition to those that are rendered, with all their spherical
        harmonics; they have no gradients.

    Attributes
    ----------
    device : Device or None
        None for the reference.
    config, background
        The arguments.
    backdrop : Gaussians or None
        The argument, with its arrays where the stages run.
    stages : Stages
        Functions of the stages: launches on the device, or the twins of the reference.

    Raises
    ------
    InputError
        If `device` is another text, a setting is out of range, or the background is not three finite numbers.
    DeviceError
        If there is no OpenCL device where one is needed.
    """

    def __init__(
        self,
        device: "Device | Literal['reference'] | None" = None,
        config: RenderConfig = RenderConfig(),
        background: Color = BLACK,
        backdrop: Gaussians | None = None,
    ):
        check(config)
        if config.projection == "ray" and config.sort == "pixel":
            raise InputError(
                "sort: expected auto, global or per_tile for the projection along rays, found pixel; it needs the "
                "affine projection"
            )
        check_color("background", background)
        self.config, self.background = config, background
        self.device: Device | None = None
        self.stages: Stages = reference
        if isinstance(device, str):
            if device != "reference":
                raise InputError(f'device: expected a Device, None or "reference", found {device!r}')
        else:
            from clsplat.ops import Launches

            self.device = device or default_device()
            self.stages = Launches(self.device)
        self.backdrop = None if backdrop is None or not len(backdrop) else self.place(backdrop)

    @property
    def label(self) -> str:
        """Name of the device for people."""
        return "float64 reference, no OpenCL" if self.device is None else self.device.label

    @property
    def real(self) -> Any:
        """Type of the reals of an image."""
        return np.dtype(np.float64) if self.device is None else self.device.real

    def tile_size(self, camera: Camera) -> int:
        """Edge of the tiles of a camera's image, px."""
        if self.device is None:  # the reference works splat by splat and gains nothing from tiles
            return max(camera.width, camera.height)
        if self.config.tile_size != "auto":
            return self.config.tile_size
        by_pixel = self.config.sort == "pixel"  # the same kernels on all devices
        compositor = "auto" if by_pixel else self.config.compositor
        if not (self.device.is_cpu if compositor == "auto" else compositor == "cpu"):
            return GPU_TILE
        return WIDE_TILE if self.device.vector_width == WIDE_TILE // 2 and not by_pixel else TILE

    def upload(self, name: str, array: Any, dtype: Any = None) -> Any:
        """An array where the stages run: on the device in its precision, or float64; `dtype` names another type."""
        if self.device is None:
            return np.asarray(array, dtype=dtype or np.float64)
        return self.device.upload(name, array, dtype)

    def zeros(self, name: str, shape: tuple[int, ...]) -> Any:
        """An array of zeros where the stages run."""
        return np.zeros(shape) if self.device is None else self.device.zeros(name, shape)

    def no_alpha_gradient(self, camera: Camera) -> Any:
        """Zero gradients with respect to the alpha of a camera's image, for losses that do not depend on it."""
        size = camera.height * camera.width
        # No kernel writes this buffer: it is filled once per size.
        return (
            np.zeros((camera.height, camera.width)) if self.device is None else self.device.scratch("v_alpha", size)
        )

    def place(self, gaussians: Gaussians) -> Gaussians:
        """The Gaussians where the stages run: uploaded from the host; those of the device as they are."""
        if self.device is None:
            return fetch(gaussians).astype(np.float64)
        if not isinstance(gaussians.means, np.ndarray):
            return gaussians
        return Gaussians(**{name: self.upload(name, array) for name, array in gaussians.arrays().items()})

    def forward(
        self,
        gaussians: Gaussians,
        camera: Camera,
        sh_degree: int | None = None,
        *,
        background: Any = None,
        depth: bool | Literal["inverse"] = False,
        gradients: bool = True,
        dropout: Dropout | None = None,
    ) -> Pass:
        """Run the stages from Gaussians to an image.

        Parameters
        ----------
        gaussians : Gaussians of N >= 1 rows
            On the host or where the stages run.
        camera : Camera
            An equirectangular one needs the projection along rays. If neither it nor the configuration has a near
            plane, that is at 0.01, whatever the size of the scene; `render` chooses it by `default_near`.
        sh_degree : int, optional
            Highest degree of the spherical harmonics evaluated; default: all that are stored.
        background : (3,) floats, optional
            Another than the renderer's.
        depth : bool or "inverse"
            Composite the depth, or the inverse depth, as a fourth channel.
        gradients : bool
            Whether `backward` follows; otherwise its lists of intersections are left out.
        dropout : Dropout, optional
            The splats left out while training.

        Returns
        -------
        Pass
        """
        gaussians, config = self.place(gaussians), self.config
        degree = gaussians.sh_degree if sh_degree is None else sh_degree
        camera = self._near(camera)
        behind = np.array([*(self.background if background is None else background), *[0.0] * bool(depth)])
        inverse = depth == "inverse"
        splats = self.project(gaussians, camera, degree, len(behind), inverse, dropout.gain if dropout else 1.0)
        if dropout:
            self.stages.dropout_fwd(splats, dropout)
        drawn = splats
        if self.backdrop is not None:
            others = self.project(self.backdrop, camera, self.backdrop.sh_degree, len(behind), inverse)
            drawn = self._joined(splats, others)
        by_pixel = config.sort == "pixel"
        scheme = "auto" if by_pixel else config.sort
        bins = self.stages.bin_splats(
            drawn, camera.width, camera.height, self.tile_size(camera), gradients=gradients, scheme=scheme
        )
        disparities = self.stages.project_disparities(gaussians, camera, splats) if by_pixel else None
        if by_pixel and self.backdrop is not None:
            more = self.stages.project_disparities(self.backdrop, camera, others)
            disparities = self.stages.join_rows(disparities, more)
        image = self.stages.composite_fwd(drawn, bins, behind, compositor=config.compositor, disparities=disparities)
        return Pass(gaussians, camera, degree, splats, drawn, bins, image, disparities, dropout, inverse)

    def recolored(self, run: Pass, colors: Any) -> Image:
        """Composite the splats of a forward pass with other colours, on black.

        Parameters
        ----------
        run : Pass
        colors : (M, 3) array
            Of all splats that the pass has drawn, where the stages run.
        """
        drawn, bins = run.drawn._replace(colors=colors), run.bins._replace(slots=None)  # no gradients follow
        return self.stages.composite_fwd(
            drawn, bins, np.zeros(3), compositor=self.config.compositor, disparities=run.disparities
        )

    def _near(self, camera: Camera) -> Camera:
        near = self.config.near
        return camera if near in (None, camera.near) else replace(camera, near=near)

    def project(
        self,
        gaussians: Gaussians,
        camera: Camera,
        sh_degree: int,
        channels: int = 3,
        inverse: bool = False,
        gain: float = 1.0,
    ) -> AnySplats:
        """Splats of placed Gaussians, for a dropout of this gain. A fourth channel is the depth, or its inverse."""
        options = {"antialiased": self.config.mode == "antialiased", "rays": along_rays(self.config, camera)}
        splats = self.stages.project_fwd(
            gaussians, self._near(camera), sh_degree, channels=channels, gain=gain, **options
        )
        if inverse:
            self.stages.disparity_fwd(splats)
        return splats

    def _joined(self, splats: AnySplats, others: AnySplats) -> AnySplats:
        """Splats of two scenes. The directions of rays belong to the camera, not to a splat."""
        rows = zip(splats._asdict().items(), others, strict=True)
        joined = {name: a if name == "directions" else self.stages.join_rows(a, b) for (name, a), b in rows}
        return type(splats)(**joined)

    def backward_to_splats(self, run: Pass, v_image: Image) -> AnyGrads:
        """Gradients with respect to the splats: the first half of `backward`."""
        v_splats = self.stages.composite_bwd(
            run.drawn, run.bins, run.image, v_image, compositor=self.config.compositor, disparities=run.disparities
        )
        if run.drawn is not run.splats:
            v_splats = type(v_splats)(*(v[: len(run.gaussians)] for v in v_splats))
        if run.inverse:
            self.stages.disparity_bwd(run.splats, v_splats)
        if run.dropout:
            self.stages.dropout_bwd(run.splats, v_splats, run.dropout)
        return v_splats

    def backward(self, run: Pass, v_image: Image, *, camera_grad: bool = False) -> Gradients:
        """Gradients of a forward pass.

        Parameters
        ----------
        run : Pass
        v_image : Image
            Gradients with respect to its image and alpha, where the stages run.
        camera_grad : bool
            Whether the camera's gradients are computed.
        """
        v_splats = self.backward_to_splats(run, v_image)
        v_gaussians, v_camera = self.stages.project_bwd(
            run.gaussians,
            run.camera,
            run.sh_degree,
            run.splats,
            v_splats,
            antialiased=self.config.mode == "antialiased",
            camera_grad=camera_grad,
        )
        return Gradients(v_gaussians, v_splats.means2d, *(v_camera or (None, None)))


def along_rays(config: RenderConfig, camera: Camera) -> bool:
    """Whether Gaussians are evaluated along rays. For an orthographic camera, the affine projection is exact."""
    return config.projection == "ray" and camera.model != "orthographic"


def default_device() -> "Device":
    """The OpenCL device that `clsplat.device.select_device` chooses, opened once and kept.

    Raises
    ------
    DeviceError
        If there is none.
    """
    with _OPENING:
        return opened_device()


@cache
def opened_device() -> "Device":
    """The device of `default_device`, which lets in one thread at a time."""
    from clsplat.device import Device

    try:
        return Device()
    except DeviceError as error:
        raise DeviceError(f'{error}; device="reference" renders in NumPy, slowly') from error


def download(array: Any) -> Array:
    """A device array on the host; a NumPy array as it is."""
    return array if isinstance(array, np.ndarray) else array.get()


def fetch(gaussians: Gaussians) -> Gaussians:
    """Gaussians of the device on the host; those of the host as they are."""
    return Gaussians(**{name: download(array) for name, array in gaussians.arrays().items()})
