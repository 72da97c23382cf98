"""Ray-traced photos of a still life, with known cameras and geometry: a scene that needs no download.

Belongs here: the photos and what makes them. Does not belong here: splatting; nothing but the camera is shared with
it, so that the photos can test it.
"""

from clsplat.demo.known_photos import known_scene, make_photos

__all__ = ["known_scene", "make_photos"]
