"""Structure from motion through pycolmap: features and matches, camera poses, points, and a summary of the result.

Belongs here: everything that calls pycolmap to find poses or points. Does not belong here: reading the models of
others (`clsplat.dataset.colmap`).
"""
