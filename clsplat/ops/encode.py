"""Launches of the stage encode (cl/encode.cl)."""

from pyopencl.array import Array

from clsplat.device import Device
from clsplat.field_stages import encoded_width


def encode_points(device: Device, points: Array, levels: int) -> Array:
    """Sines and cosines of points at several frequencies (Mildenhall et al. 2020, equation 4).

    Parameters
    ----------
    points : (S, 3) real
        In [-1, 1].
    levels : int
        Number of frequencies.

    Returns
    -------
    (S, encoded_width(levels)) real
        The points; for each frequency three sines and three cosines; 1; zeros.
    """
    count, width = points.shape[0], encoded_width(levels)
    encoded = device.empty("encoded points", (count, width))
    device.launch("encode", "encode_points", (count,), [count, levels, width, points, encoded])
    return encoded


def encode_join(device: Device, features: Array, rows: Array, rectify: bool) -> Array:
    """Join features of samples with encodings.

    Parameters
    ----------
    features : (S, W) real
    rows : (Q, E) real
        Q divides S: S / Q samples, one after the other, share a row.
    rectify : bool
        Whether negative features become 0.

    Returns
    -------
    (S, W + E) real
    """
    count, wide, width = features.shape[0], features.shape[1], rows.shape[1]
    joined = device.empty("joined", (count, wide + width))
    arguments = [count, wide, width, count // rows.shape[0], int(rectify), features, rows, joined]
    device.launch("encode", "encode_join", (count,), arguments)
    return joined


def encode_join_bwd(device: Device, v_joined: Array, features: Array, rectify: bool) -> Array:
    """Gradient of `encode_join` with respect to the features, (S, W), from v_joined (S, W + E).

    Columns of v_joined after the first W are not read, and may be missing.
    """
    count, wide = features.shape
    v_features = device.empty("v_features", features.shape)
    arguments = [count, wide, v_joined.shape[1] - wide, int(rectify), features, v_joined, v_features]
    device.launch("encode", "encode_join_bwd", (count,), arguments)
    return v_features
