"""Datasets: from a folder of photos or a video to a `Scene` of posed photos in memory.

Belongs here: locating and decoding photos, frames of videos, COLMAP models, ``transforms.json``, lens models,
structure from motion, depth maps, what of a photo other photos show, where outlines tell that an object is, how
bright photos are. Does not belong here: Gaussians, training, and files of Gaussians (`clsplat.formats`).
"""

from clsplat.dataset.loading import (
    load_photos,
    load_scene,
    load_scene_with_points,
    read_depth_maps,
    with_depth_maps,
    with_points,
)

__all__ = [
    "load_photos",
    "load_scene",
    "load_scene_with_points",
    "read_depth_maps",
    "with_depth_maps",
    "with_points",
]
