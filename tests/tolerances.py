"""Every tolerance of the tests by tables: quantity -> (rtol, atol, why), see `clsplat.testing.Tolerance`.

rtol is a fraction of each expected value, atol of the largest. Float errors are 2 to 10 times those of PoCL (x86):
other devices contract and order sums otherwise.
"""

from clsplat.testing import Tolerance

_REORDERED = Tolerance(1e-11, 1e-13, "float64 on both sides: sums in another order")
_CANCELS = Tolerance(1e-10, 1e-12, "float64 on both sides: for needles determinants and their gradients cancel")
_UPDATED = Tolerance(
    1e-12, 1e-13, "float64 on both sides: a hundred updates, each rounded, and gradients that cancel"
)

DOUBLE = {
    "means2d": _REORDERED,
    "conics": _CANCELS,
    "depths": _REORDERED,
    "extents": _REORDERED,
    "opacities": _REORDERED,
    "colors": _REORDERED,
    "disparities": _CANCELS,
    "rays": _CANCELS,
    "directions": _REORDERED,
    "v_slopes": _CANCELS,
    "filtered log_scales": _REORDERED,
    "filtered logit_opacities": _CANCELS,
    "image": _REORDERED,
    "rgb": _REORDERED,
    "alpha": _REORDERED,
    "depth": _CANCELS,
    "loss": _REORDERED,
    "v_image": _REORDERED,
    "v_affine": _CANCELS,
    "v_means2d": _CANCELS,
    "v_conics": _CANCELS,
    "v_opacities": _CANCELS,
    "v_colors": _CANCELS,
    "v_means": _CANCELS,
    "v_log_scales": _CANCELS,
    "v_quats": _CANCELS,
    "v_logit_opacities": _CANCELS,
    "v_sh": _CANCELS,
    "v_viewmat": _CANCELS,
    "v_intrinsics": _CANCELS,
    "parameters": _UPDATED,
    "first moments": _UPDATED,
    "second moments": _UPDATED,
    "grad_sum": _UPDATED,
    "errors": _CANCELS,
    "differences": _CANCELS,
    "weights": _REORDERED,
    "squares": _REORDERED,
    "pulls": _CANCELS,
    "moved means": _REORDERED,
    "moved world": Tolerance(1e-9, 1e-11, "float64: translations of 10 units and scales of 40 cost three digits"),
}

ALONG_RAYS = DOUBLE | {
    "v_log_scales": Tolerance(1e-10, 1e-11, "float64: close to the camera's plane, vectors of up to 1e4 px cancel"),
    "v_quats": Tolerance(1e-10, 1e-11, "float64: as for v_log_scales"),
    "v_means": Tolerance(1e-10, 1e-11, "float64: as for v_log_scales"),
}

_NEEDLE = "float32: the gradient by a needle's covariance cancels along its axis"
_SUM = "float32: a sum over up to 1e4 pixels, whose terms cancel in part"

FLOAT = {
    "means2d": Tolerance(1e-5, 1e-6, "float32: a coordinate may cancel against the camera's position"),
    "conics": Tolerance(1e-4, 3e-6, "float32: covariances of up to 1e4 px^2 are inverted"),
    "depths": Tolerance(1e-6, 5e-7, "float32: three products and a translation"),
    "extents": Tolerance(2e-5, 1e-6, "float32: the logarithm of an opacity close to ALPHA_MIN cancels"),
    "opacities": Tolerance(1e-6, 1e-6, "float32: exp of a logit, and two determinants"),
    "colors": Tolerance(1e-6, 1e-6, "float32: sixteen products"),
    "filtered log_scales": Tolerance(1e-6, 1e-6, "float32: logarithms to another base and back"),
    "filtered logit_opacities": Tolerance(1e-5, 3e-6, "float32: 1 less a factor close to 1 cancels"),
    "disparities": Tolerance(1e-3, 2e-5, "float32: the slope by a needle's covariance cancels along its axis"),
    "image": Tolerance(1e-6, 3e-6, "float32: up to a hundred pairs per pixel, each with an exp"),
    "rgb": Tolerance(1e-6, 5e-6, "float32: as for image, and what project adds"),
    "alpha": Tolerance(1e-6, 3e-6, "float32: as for image"),
    "depth": Tolerance(3e-5, 1e-6, "float32: a quotient by alpha, which is at least 0.01 where depths are compared"),
    "loss": Tolerance(1e-6, 0, "float32: sums over 24 vectors of 64 rows, then a tree"),
    "v_image": Tolerance(1e-5, 3e-6, "float32: SSIM's variances cancel where the image is flat"),
    "v_affine": Tolerance(1e-4, 1e-5, _SUM),
    "v_means2d": Tolerance(1e-4, 2e-5, _SUM),
    "v_conics": Tolerance(1e-4, 1e-5, _SUM),
    "v_slopes": Tolerance(1e-4, 2e-5, _SUM),
    "v_opacities": Tolerance(1e-4, 2e-5, _SUM),
    "v_colors": Tolerance(1e-5, 2e-6, _SUM),
    "v_means": Tolerance(1e-3, 2e-5, _NEEDLE),
    "v_log_scales": Tolerance(1e-3, 2e-4, _NEEDLE),
    "v_quats": Tolerance(1e-3, 2e-4, _NEEDLE),
    "v_logit_opacities": Tolerance(1e-4, 2e-5, _SUM),
    "v_sh": Tolerance(1e-4, 5e-6, _SUM),
    "v_viewmat": Tolerance(1e-4, 2e-5, _SUM),
    "v_intrinsics": Tolerance(1e-4, 2e-5, _SUM),
    "errors": Tolerance(
        1e-4, 1e-5, "float32: what lies behind is what earlier splats left of the whole, times up to 99"
    ),
    "differences": Tolerance(1e-4, 1e-5, "float32: as for errors"),
    "weights": Tolerance(1e-5, 1e-6, _SUM),
    "squares": Tolerance(1e-5, 1e-6, _SUM),
    "pulls": Tolerance(1e-5, 2e-6, _SUM),
    "parameters": Tolerance(1e-6, 1e-5, "float32: a hundred updates, each rounded"),
    "first moments": Tolerance(1e-6, 2e-6, "float32: gradients of both signs cancel"),
    "second moments": Tolerance(2e-6, 0, "float32: a hundred updates, each rounded"),
    "moved means": Tolerance(1e-6, 1e-6, "float32: a random step of the size of the coordinate"),
    "grad_sum": Tolerance(1e-6, 0, "float32: a root and a sum of positive numbers, each rounded"),
}
