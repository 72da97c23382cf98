"""Launch of the stage frustums (cl/frustums.cl)."""

from pyopencl.array import Array

from clsplat.device import Device
from clsplat.field_stages import FRUSTUM_AXES, Span, frustum_width

# Axes that a work-item takes at once on a CPU.
LANES = 8


def frustums_encode(
    device: Device, origins: Array, directions: Array, radii: Array, edges: Array, span: Span, levels: int
) -> tuple[Array, Array]:
    """Integrated encodings of conical frustums (Barron et al. 2021, equation 14; Barron et al. 2022).

    Parameters
    ----------
    origins, directions : (R, 3) real
        As for `intervals_along`.
    radii : (R,) real
        Radius of the cone of each ray at a distance of 1.
    edges : (R, N + 1) real
        Of the intervals, as for `intervals_along`.
    span : Span
    levels : int
        Number of frequencies.

    Returns
    -------
    encoded : (R N, frustum_width(levels)) real
        For each frequency a sine and a cosine of each axis; 1; zeros.
    deltas : (R N,) real
        Lengths of the intervals.
    """
    rays, count, width = edges.shape[0], edges.shape[1] - 1, frustum_width(levels)
    samples, axes = rays * count, device.constant("axes of frustums", FRUSTUM_AXES)
    encoded, deltas = device.empty("encoded frustums", (samples, width)), device.empty("deltas", samples)
    scalars = [samples, count, len(FRUSTUM_AXES), levels, width, float(span.near), float(span.far)]
    arguments = [*scalars, origins, directions, radii, edges, axes, encoded, deltas]
    defines = {"CONTRACTED": int(span.contracted), "LANES": LANES if device.is_cpu else 1}
    device.launch("frustums", "frustums_encode", (samples,), arguments, defines=defines)
    return encoded, deltas
