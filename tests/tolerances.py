"""Every tolerance of the tests: quantity -> (rtol, atol, why), see `clsplat.testing.Tolerance`.

rtol is a fraction of each expected value, atol of the largest. Float errors are measured on PoCL (x86) and rounded up by
a factor of 3 to 10: other devices may contract and order sums otherwise.
"""

from clsplat.testing import Tolerance

_REORDERED = "float64 on both sides: a few hundred ulps for sums in another order"
_CANCELS = "float64 on both sides; the determinant of a 2D covariance may cancel by a factor of 1e3"

DOUBLE = {
    "means2d": Tolerance(1e-12, 1e-13, _REORDERED),
    "conics": Tolerance(1e-10, 1e-12, _CANCELS),
    "depths": Tolerance(1e-12, 1e-13, _REORDERED),
    "extents": Tolerance(1e-11, 1e-13, _REORDERED),
    "opacities": Tolerance(1e-11, 1e-13, _REORDERED),
    "colors": Tolerance(1e-11, 1e-13, _REORDERED),
}
DOUBLE |= {
    f"v_{name}": Tolerance(1e-9, 1e-12, _CANCELS)
    for name in ("means", "log_scales", "quats", "logit_opacities", "sh", "viewmat")
}

FLOAT = {
    "means2d": Tolerance(1e-5, 1e-6, "float32: 1e-7 of a coordinate that may cancel against the camera's"),
    "conics": Tolerance(1e-3, 1e-5, "float32: needles cancel in the determinant"),
    "depths": Tolerance(1e-6, 1e-6, "float32"),
    "extents": Tolerance(1e-5, 1e-6, "float32"),
    "opacities": Tolerance(1e-5, 1e-6, "float32"),
    "colors": Tolerance(1e-5, 1e-6, "float32"),
}
FLOAT |= {
    f"v_{name}": Tolerance(1e-3, 1e-4, "float32: for a needle the gradient by its covariance cancels along its axis")
    for name in ("means", "log_scales", "quats", "logit_opacities", "sh", "viewmat")
}

DOUBLE |= {
    "image": Tolerance(1e-11, 1e-13, _REORDERED),
    "alpha": Tolerance(1e-11, 1e-13, _REORDERED),
    "v_means2d": Tolerance(1e-9, 1e-12, _CANCELS),
    "v_conics": Tolerance(1e-9, 1e-12, _CANCELS),
    "v_opacities": Tolerance(1e-9, 1e-12, _CANCELS),
    "v_colors": Tolerance(1e-9, 1e-12, _CANCELS),
}
FLOAT |= {
    "image": Tolerance(1e-5, 1e-6, "float32"),
    "alpha": Tolerance(1e-5, 1e-6, "float32"),
    "v_means2d": Tolerance(1e-3, 1e-5, "float32"),
    "v_conics": Tolerance(1e-3, 1e-5, "float32"),
    "v_opacities": Tolerance(1e-3, 1e-5, "float32"),
    "v_colors": Tolerance(1e-3, 1e-5, "float32"),
}

DOUBLE |= {
    "loss": Tolerance(1e-12, 0, _REORDERED),
    "v_image": Tolerance(1e-10, 1e-12, _REORDERED),
}
FLOAT |= {
    "loss": Tolerance(1e-5, 0, "float32"),
    "v_image": Tolerance(1e-3, 1e-4, "float32"),
}

DOUBLE |= {
    "rgb": DOUBLE["image"],
    "depth": Tolerance(1e-9, 1e-12, _REORDERED),
    "moved world": Tolerance(1e-9, 1e-11, "float64; translations of 10 units and scales of 40 cost three digits"),
}
FLOAT |= {
    "rgb": FLOAT["image"],
    "depth": Tolerance(1e-4, 1e-5, "float32: a quotient by alpha, which is at least 0.01 where depths are compared"),
}
