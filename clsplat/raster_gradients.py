"""Gradients of `rasterization`: with respect to activated parameters, values of D channels, and cameras."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.raster_arguments import exponents, on_host
from clsplat.renderer import Renderer, download, fetch
from clsplat.stages import AnyGrads, AnySplats, Bins, Image

Array = NDArray[Any]


class RasterPass(NamedTuple):
    """Forward pass of one camera, for its gradients.

    splats: as projected, with RGB and the depth as colours; colored: the same with the values that were composited.
    render (H, W, X), alpha (H, W, 1) and background (X,) are on the host, the others where the stages ran.
    channels: D.
    """

    camera: Camera
    splats: AnySplats
    colored: AnySplats
    bins: Bins
    image: Image
    render: Array
    alpha: Array
    background: Array
    render_mode: str
    channels: int


class RasterPasses(NamedTuple):
    """Forward passes of all cameras, and what their gradients need.

    placed, gaussians: the Gaussians where the stages run, and on the host; sh_degree: as given to `rasterization`;
    shared: whether all cameras have the same values.
    """

    renderer: Renderer
    placed: Gaussians
    gaussians: Gaussians
    runs: list[RasterPass]
    sh_degree: int | None
    antialiased: bool
    shared: bool


class RasterGradients(NamedTuple):
    """Gradients of a scalar with respect to the arguments of `rasterization`, in the arguments' shapes.

    Attributes
    ----------
    means, quats, scales, opacities : arrays in the arguments' shapes, float64
        Gradients with respect to the activated parameters.
    colors : (N, D), (C, N, D) or (N, K, 3) float64
        Gradients with respect to the values, or to the coefficients of spherical harmonics; summed over the cameras
        if these share them.
    viewmats : (C, 4, 4) float64
        Each entry of the upper three rows is an independent variable; the last row is 0.
    Ks : (C, 3, 3) float64
        Gradients with respect to fx, fy, cx and cy; 0 elsewhere.
    backgrounds : (C, D) float64
        Gradients with respect to the backgrounds.
    means2d : (C, N, 2)
        Gradients with respect to the splats' centres, per px, which densification uses.
    absgrad : (C, N, 2) or None
        Sums over pixels of the absolute gradients with respect to the splats' centres, per px (Ye et al. 2024,
        "AbsGS"); None without ``absgrad=True``.
    """

    means: Array
    quats: Array
    scales: Array
    opacities: Array
    colors: Array
    viewmats: Array
    Ks: Array
    backgrounds: Array
    means2d: Array
    absgrad: Array | None = None


class _Outputs(NamedTuple):
    render: Array
    alpha: Array
    meta: dict[str, Any]


class Rasterization(_Outputs):
    """The result of `rasterization`: the tuple (render, alpha, meta), and its gradients."""

    _passes: RasterPasses | None = None

    def remember(self, passes: RasterPasses) -> None:
        """Keep what `backward` needs; `rasterization` calls it."""
        self._passes = passes

    def backward(self, v_render: Any, v_alpha: Any = None, *, absgrad: bool = False) -> RasterGradients:
        """Gradients of a scalar with respect to the Gaussians and the cameras.

        Parameters
        ----------
        v_render : (C, H, W, X)
            The scalar's gradient with respect to render.
        v_alpha : (C, H, W, 1), optional
            The same for alpha; default 0.
        absgrad : bool
            Whether absolute gradients with respect to the centres are computed, too.

        Returns
        -------
        RasterGradients
            float64. The gradient of an opacity of 0 or 1, and of a scale of 0, is 0: the kernels differentiate
            logits and logarithms.

        Raises
        ------
        InputError
            If `gradients` was not set, or a shape does not fit.
        """
        if self._passes is None:
            raise InputError("gradients: expected a rasterization made with gradients=True, found another")
        renderer, placed, gaussians, runs, sh_degree, antialiased, shared = self._passes
        v_render = _checked("v_render", v_render, self.render.shape)
        v_alpha = np.zeros(self.alpha.shape) if v_alpha is None else _checked("v_alpha", v_alpha, self.alpha.shape)
        total = {name: np.zeros(array.shape) for name, array in gaussians.arrays().items()}
        values, viewmats, intrinsics, backgrounds, means2d, sums = [], [], [], [], [], []
        for run, v_image, v_cover in zip(runs, v_render, v_alpha, strict=True):
            placed_v = _placed(renderer, run, v_image, v_cover)
            v_splats, v_values = _to_splats(renderer, run, placed_v, sh_degree is not None)
            if absgrad:
                sums.append(download(renderer.stages.absgrad(run.colored, run.bins, run.image, placed_v)))
            v, v_camera = renderer.stages.project_bwd(
                placed,
                run.camera,
                sh_degree or 0,
                run.splats,
                v_splats,
                antialiased=antialiased,
                camera_grad=True,
            )
            for name, array in fetch(v).arrays().items():
                total[name] += array
            assert v_camera is not None
            values.append(v_values)
            viewmats.append(v_camera.viewmat)
            intrinsics.append(_matrix(v_camera.intrinsics))
            plain = np.zeros((*v_image.shape[:2], run.channels))
            shown = v_image[:, :, : run.channels] if "RGB" in run.render_mode else plain
            backgrounds.append(((1 - run.alpha) * shown).sum(axis=(0, 1)))
            means2d.append(download(v_splats.means2d))
        v_features = np.stack(values)
        return RasterGradients(
            total["means"],
            np.ldexp(total["quats"], -exponents(gaussians.quats)),
            _quotient(total["log_scales"], np.asarray(gaussians.scales, np.float64)),
            _quotient(total["logit_opacities"], gaussians.opacities * (1 - gaussians.opacities)),
            total["sh"] if sh_degree is not None else v_features.sum(axis=0) if shared else v_features,
            np.stack(viewmats),
            np.stack(intrinsics),
            np.stack(backgrounds),
            np.stack(means2d),
            np.stack(sums) if absgrad else None,
        )


def _placed(renderer: Renderer, run: RasterPass, v_image: Array, v_alpha: Array) -> Image:
    """Gradients with respect to what was composited, where the stages run."""
    v_image, v_cover = v_image.copy(), v_alpha[:, :, 0].copy()
    if "ED" in run.render_mode:  # the accumulated depth over alpha
        alpha = run.alpha[:, :, 0].astype(np.float64)
        v_image[:, :, -1] = np.divide(v_image[:, :, -1], alpha, out=np.zeros_like(alpha), where=alpha > 0)
        v_cover -= v_image[:, :, -1] * run.render[:, :, -1]
    return Image(renderer.upload("v_image", v_image), renderer.upload("v_alpha", v_cover))


def _to_splats(renderer: Renderer, run: RasterPass, v_image: Image, harmonics: bool) -> tuple[AnyGrads, Array]:
    """Gradients with respect to the splats with RGB and depth, and to the values (N, D) that were composited."""
    v = renderer.stages.composite_bwd(run.colored, run.bins, run.image, v_image)
    v_colors = download(v.colors).astype(np.float64)
    deep = "D" in run.render_mode
    v_values = v_colors[:, : run.channels] if "RGB" in run.render_mode else np.zeros((len(v_colors), run.channels))
    onward = np.zeros((len(v_colors), 4))
    if harmonics:
        onward[:, :3] = v_values
    if deep:
        onward[:, 3] = v_colors[:, -1]
    return v._replace(colors=renderer.upload("v_colors", onward)), v_values


def _matrix(intrinsics: Array) -> Array:
    """The gradient of fx, fy, cx, cy as that of K (3, 3)."""
    fx, fy, cx, cy = intrinsics
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 0]])


def _quotient(x: Array, y: Array) -> Array:
    return np.divide(x, y, out=np.zeros_like(x), where=y > 0)


def _checked(name: str, array: Any, expected: tuple[int, ...]) -> Array:
    array = np.asarray(on_host(name, array), np.float64)
    if array.shape != expected:
        raise InputError(f"{name}: expected shape {expected}, found {array.shape}")
    return array
