"""Structure from motion through pycolmap: features and matches, camera poses, points, and a summary of the result.

Belongs here: everything that calls pycolmap to compute poses or points. Does not belong here: reading existing COLMAP
models as datasets (`clsplat.dataset.colmap`), and camera models (`clsplat.dataset.lenses`).
"""
