"""From a folder or a video to posed photos in memory.

Belongs here: finding and decoding photos, COLMAP models, ``transforms.json``, camera models, structure from motion.
Does not belong here: Gaussians, training, and files of Gaussians.
"""

from clsplat.dataset.loading import load_scene, with_points

__all__ = ["load_scene", "with_points"]
