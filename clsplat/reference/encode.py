"""Twin of the stage encode."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.field_stages import encoded_width

Array = NDArray[Any]


def encode_points(points: Array, levels: int) -> Array:
    """Sines and cosines of points. Arguments and result as for `clsplat.ops.encode_points`."""
    angles = np.pi * 2.0 ** np.arange(levels)[:, None] * points[:, None]
    waves = np.concatenate([np.sin(angles), np.cos(angles)], axis=2).reshape(len(points), -1)
    encoded = np.zeros((len(points), encoded_width(levels)))
    encoded[:, :3], encoded[:, 3 : 3 + 6 * levels], encoded[:, 3 + 6 * levels] = points, waves, 1
    return encoded


def encode_join(features: Array, rows: Array, rectify: bool) -> Array:
    """Join features with encodings. Arguments and result as for `clsplat.ops.encode_join`."""
    kept = np.maximum(features, 0) if rectify else features
    return np.concatenate([kept, np.repeat(rows, len(features) // len(rows), axis=0)], axis=1)


def encode_join_bwd(v_joined: Array, features: Array, rectify: bool) -> Array:
    """Gradient of `encode_join`. Arguments and result as for `clsplat.ops.encode_join_bwd`."""
    v_features = v_joined[:, : features.shape[1]].copy()
    return np.where(features > 0, v_features, 0) if rectify else v_features
