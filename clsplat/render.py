"""Rendered images that know their gradients: `render`, `render_views` and the `Rendering` they return."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import chain
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from clsplat import display, panorama
from clsplat.camera import Camera, default_near
from clsplat.config import RenderConfig
from clsplat.errors import InputError, whole
from clsplat.gaussians import Gaussians
from clsplat.renderer import BLACK, Gradients, Pass, Renderer, along_rays, download, fetch
from clsplat.scene import Color
from clsplat.stages import Image, RaySplats
from clsplat.surface import Surface, surface_of

if TYPE_CHECKING:
    from clsplat.device import Device

Array = NDArray[Any]


class Stored(Protocol):
    """Gaussians that are read in parts: only those that some cameras may show are in memory at a time."""

    def __len__(self) -> int: ...

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics."""
        ...

    def shown(self, renderer: Renderer, cameras: Iterable[Camera]) -> Iterator[tuple[list[Camera], Gaussians]]:
        """Yield the cameras, some at a time, and the Gaussians that these cameras may show; both in their order.

        Gaussians that are left out would not be drawn. Each camera needs a near plane, because the default would
        depend on the Gaussians that are read.
        """
        ...


class Rendering:
    """A rendered image that can differentiate itself; made by `render` and, without gradients, by `render_views`.

    Attributes
    ----------
    rgb : (H, W, 3)
        Colours, background included; not clamped above.
    alpha : (H, W)
        1 - transmittance.
    depth : (H, W) or None
        Expected depth: the mean of the splats' depths in world units (z; distances for a fisheye and a panorama),
        weighted as the colours are; 0 where alpha is 0. None without ``depth=True``.
    """

    def __init__(self, renderer: Renderer, run: Pass | None, gaussians: Gaussians, image: Array, alpha: Array):
        self._renderer, self._run, self._gaussians = renderer, run, gaussians
        self.rgb, self.alpha = image[:, :, :3], alpha
        self.depth: Array | None = None
        if image.shape[2] == 4:
            self.depth = _quotient(image[:, :, 3], alpha)

    def _repr_png_(self) -> bytes:
        return display.png(self.rgb)

    def surface(self) -> Surface:
        """Find the surface in the image: median depths and normals. They have no gradient.

        Raises
        ------
        InputError
            As `backward`, which needs the same parts of the rendering.
        """
        if self._run is None:
            self._check(None, None, None, False)
            height, width = self.alpha.shape
            ids, zeros = np.full((height, width), -1, np.int32), np.zeros((height, width, 4))
            return Surface(ids, zeros[:, :, 0], zeros[:, :, 1:])
        run = self._run
        ids = download(self._renderer.stages.median_splats(run.drawn, run.bins))
        # What was rendered: the caller may have changed the Gaussians since.
        return surface_of(fetch(run.gaussians), run.camera, np.where(ids < len(self._gaussians), ids, -1))

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
            The scalar's gradients with respect to them; default: 0.
        viewmat_grad, intrinsics_grad : bool
            Also return the gradient with respect to the viewmat, and to fx, fy, cx, cy.

        Returns
        -------
        Gradients
            NumPy arrays.

        Raises
        ------
        InputError
            If a shape does not fit, v_depth is given though no depth was rendered, or the rendering was made without
            gradients.
        """
        self._check(v_rgb, v_alpha, v_depth, intrinsics_grad)
        if self._run is None:
            zeros = Gaussians(**{k: np.zeros_like(a) for k, a in self._gaussians.arrays().items()})
            result = Gradients(zeros, np.zeros((0, 2)), np.zeros((4, 4)), np.zeros(4))
        else:
            v_image = self._image_gradients(v_rgb, v_alpha, v_depth)
            v_image = Image(*(self._renderer.upload("v_image", array) for array in v_image))
            result = self._renderer.backward(self._run, v_image, camera_grad=viewmat_grad or intrinsics_grad)
            result = result._replace(gaussians=fetch(result.gaussians), means2d=download(result.means2d))
        return result._replace(
            viewmat=result.viewmat if viewmat_grad else None,
            intrinsics=result.intrinsics if intrinsics_grad else None,
        )

    def _check(
        self, v_rgb: Array | None, v_alpha: Array | None, v_depth: Array | None, intrinsics_grad: bool
    ) -> None:
        if self._run is None and len(self._gaussians):
            raise InputError(
                "gradients: expected a rendering made with gradients=True of a camera that is not equirectangular, "
                'or along its rays (projection="ray"), found another'
            )
        if intrinsics_grad and self._run and isinstance(self._run.splats, RaySplats):
            if self._run.camera.model != "pinhole":
                raise InputError(
                    "intrinsics_grad: expected a pinhole camera for the projection along rays, found one of model "
                    f"{self._run.camera.model}"
                )
        for name, v, shape in (
            ("v_rgb", v_rgb, self.rgb.shape),
            ("v_alpha", v_alpha, self.alpha.shape),
            ("v_depth", v_depth, None if self.depth is None else self.depth.shape),
        ):
            if v is not None and np.shape(v) != shape:
                raise InputError(f"{name}: expected shape {shape}, found {np.shape(v)}")

    def _image_gradients(self, v_rgb: Array | None, v_alpha: Array | None, v_depth: Array | None) -> Image:
        """Gradients with respect to the composited channels; the depth is the fourth channel over alpha."""
        assert self._run
        # Filled on the host: its dtype is that of the image.
        v_image = np.zeros((*self.alpha.shape, 3 if self.depth is None else 4), dtype=self.alpha.dtype)
        v_total_alpha = np.zeros_like(self.alpha) if v_alpha is None else np.array(v_alpha, dtype=self.alpha.dtype)
        if v_rgb is not None:
            v_image[:, :, :3] = v_rgb
        if v_depth is not None and self.depth is not None:
            # Those of the pass: the caller may have changed the ones of this object.
            alpha = download(self._run.image.alpha)
            depth = _quotient(download(self._run.image.rgb)[:, :, 3], alpha)
            v_image[:, :, 3] = _quotient(v_depth, alpha)
            v_total_alpha -= v_image[:, :, 3] * depth
        return Image(v_image, v_total_alpha)


def _quotient(sums: Array, alpha: Array) -> Array:
    """Sums (H, W) over alpha (H, W); 0 where that is 0."""
    quotient: Array = np.divide(sums, alpha, out=np.zeros_like(alpha), where=alpha > 0)
    return quotient


def render(
    gaussians: Gaussians,
    camera: Camera,
    config: RenderConfig = RenderConfig(),
    device: "Device | Literal['reference'] | None" = None,
    *,
    background: Color = BLACK,
    sh_degree: int | None = None,
    depth: bool = False,
    gradients: bool = True,
) -> Rendering:
    """Render Gaussians (Kerbl et al. 2023).

    Parameters
    ----------
    gaussians : Gaussians
        N Gaussians, pre-activation, on the host.
    camera : Camera
        Camera of any model. With the affine projection, the image of an equirectangular camera is resampled from the
        six faces of a cube, and has no gradients.
    config : RenderConfig
        Settings of rendering.
    device : Device, "reference" or None
        None takes the default OpenCL device, opened once and kept. "reference" takes the float64 twins, which are
        exact and slow, and need no OpenCL.
    background : (3,) floats
        RGB behind the Gaussians.
    sh_degree : int, optional
        Highest degree of the spherical harmonics evaluated; default: all that are stored.
    depth : bool
        Composite the expected depth too.
    gradients : bool
        Keep the inputs of `Rendering.backward` on the device. False renders only the image, which is faster.

    Returns
    -------
    Rendering

    Raises
    ------
    InputError
        If the Gaussians' shapes do not fit each other, sh_degree exceeds what is stored, a setting is out of range,
        the background is not three finite numbers, or `device` is another text.
    DeviceError
        If there is no OpenCL device, or a buffer exceeds its limits.
    """
    renderer = Renderer(device, config, background)
    return next(renderings(renderer, gaussians, [camera], sh_degree, depth=depth, gradients=gradients))


def render_views(
    gaussians: Gaussians,
    cameras: Iterable[Camera],
    config: RenderConfig = RenderConfig(),
    device: "Device | Literal['reference'] | None" = None,
    *,
    background: Color = BLACK,
    sh_degree: int | None = None,
    depth: bool = False,
) -> Iterator[Rendering]:
    """Render one image after the other, forward only; the Gaussians are uploaded once.

    Parameters
    ----------
    gaussians : Gaussians
        N Gaussians, pre-activation, on the host.
    cameras : iterable of Camera
        Cameras of any sizes. The next camera is taken when its image is needed.
    config, device, background, sh_degree, depth
        As for `render`.

    Yields
    ------
    Rendering
        One per camera, without gradients.

    Raises
    ------
    InputError, DeviceError
        As `render`.
    """
    return renderings(Renderer(device, config, background), gaussians, cameras, sh_degree, depth=depth)


def renderings(
    renderer: Renderer,
    gaussians: Gaussians | Stored,
    cameras: Iterable[Camera],
    sh_degree: int | None = None,
    *,
    depth: bool = False,
    gradients: bool = False,
) -> Iterator[Rendering]:
    """Render one image after the other with a `Renderer`; arguments and errors as for `render_views`.

    Parameters
    ----------
    gaussians : Gaussians or Stored
        Gaussians on the host or on the renderer's device.
    """
    if not isinstance(gaussians, Gaussians):
        return chain.from_iterable(
            renderings(renderer, some, looking, sh_degree, depth=depth, gradients=gradients)
            for looking, some in gaussians.shown(renderer, cameras)
        )
    if isinstance(gaussians.means, np.ndarray):
        gaussians.validate()
    degree = gaussians.sh_degree if sh_degree is None else whole("sh_degree", sh_degree)
    if not 0 <= degree <= gaussians.sh_degree:
        raise InputError(f"sh_degree: expected 0 to {gaussians.sh_degree} (what is stored), found {degree}")
    return _renderings(renderer, gaussians, cameras, degree, depth, gradients)


def _renderings(
    renderer: Renderer, gaussians: Gaussians, cameras: Iterable[Camera], degree: int, depth: bool, gradients: bool
) -> Iterator[Rendering]:
    """Generator of the images. It is separate so that errors of `renderings` come before the first image."""
    for run, image, alpha in _drawings(renderer, gaussians, cameras, degree, depth, gradients):
        shown, cover = download(image), download(alpha)
        if run and renderer.device is None:  # the arrays of the pass itself, which its gradients need
            shown, cover = shown.copy(), cover.copy()
        yield Rendering(renderer, run if gradients else None, gaussians, shown, cover)


def images(renderer: Renderer, gaussians: Gaussians, cameras: Iterable[Camera], sh_degree: int) -> Iterator[Any]:
    """Images (H, W, 3) of cameras, one after the other, where the renderer's stages run."""
    for _, image, _ in _drawings(renderer, gaussians, cameras, sh_degree, depth=False, gradients=False):
        yield renderer.upload("image", image) if isinstance(image, np.ndarray) else image


def _drawings(
    renderer: Renderer, gaussians: Gaussians, cameras: Iterable[Camera], degree: int, depth: bool, gradients: bool
) -> Iterator[tuple[Pass | None, Any, Any]]:
    """Results of `_drawn` for each camera."""
    placed = renderer.place(gaussians) if len(gaussians) else gaussians
    near: float | None = None
    for camera in cameras:
        if camera.near is None and len(gaussians):
            near = near or default_near(np.asarray(download(gaussians.means)))
            camera = replace(camera, near=near)
        yield _drawn(renderer, placed, camera, degree, depth, gradients)


def _drawn(
    renderer: Renderer, gaussians: Gaussians, camera: Camera, degree: int, depth: bool, gradients: bool
) -> tuple[Pass | None, Any, Any]:
    """The pass, where there is one, its image and its alpha: on the host, or where the stages ran."""
    if len(gaussians) == 0:
        behind = np.array([*renderer.background, *[0.0] * depth], renderer.real)
        image: Array = np.tile(behind, (camera.height, camera.width, 1))
        return None, image, np.zeros(image.shape[:2], renderer.real)
    if camera.model == "equirectangular" and not along_rays(renderer.config, camera):
        layers = []
        for face in panorama.faces(camera):
            drawn = _drawn(renderer, gaussians, face, degree, depth, gradients=False)
            image, alpha = download(drawn[1]), download(drawn[2])
            if depth:  # from depths to distances
                u, v = np.meshgrid(np.arange(face.width) + 0.5, np.arange(face.height) + 0.5)
                image = image.copy()
                image[:, :, 3] /= face.rays(u, v)[:, :, 2]
            layers.append(np.concatenate([image, alpha[:, :, None]], axis=2))
        whole = panorama.assemble(camera, layers)
        return None, whole[:, :, :-1], whole[:, :, -1]
    run = renderer.forward(gaussians, camera, degree, depth=depth, gradients=gradients)
    return run, run.image.rgb, run.image.alpha
