"""Ray-traced photos of a still life, with known cameras and geometry: a scene without a download.

Belongs here: the photos, and the ray tracer that makes them. Does not belong here: splatting. The two share only the
camera, so that the photos can test the splatting.
"""

from clsplat.demo.known_photos import known_scene, make_photos

__all__ = ["known_scene", "make_photos"]
