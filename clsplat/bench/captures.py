"""Captures: variants of a scene that show whether a method fits the scene or only its training photos."""

from dataclasses import asdict, dataclass, replace
from typing import Annotated

import numpy as np

from clsplat.config import Count, PartialFraction
from clsplat.errors import InputError
from clsplat.ranges import within
from clsplat.scene import Scene

PHOTOS_MIN = 3
"""Smallest number of training photos of a variant. With two, most of the scene is seen from one side only."""


@dataclass(frozen=True)
class Capture:
    """Settings that turn a scene into a variant of it; the defaults leave the scene as it is."""

    thin: Count = 1
    """Train on every n-th training photo by name. The held-out photos stay the same."""
    arc: PartialFraction = 0.0
    """Hold out this fraction of all photos instead of the usual ones: those nearest to the last one by name."""
    points: Annotated[float, within(above=0, most=1)] = 1.0
    """Start from this fraction of the sparse points."""

    @property
    def options(self) -> str:
        """The settings as options of a dataset on the command line, each after a colon."""
        return "".join(f":{name}={value:g}" for name, value in asdict(self).items() if value != DEFAULTS[name])

    @property
    def kind(self) -> str:
        """Group of captures to which it belongs in tables."""
        return " and ".join(KINDS[name] for name, value in asdict(self).items() if value != DEFAULTS[name]) or FULL


DEFAULTS = asdict(Capture())

FULL = "full"
"""Group of the scenes as they are."""

KINDS = {"thin": "thinned", "arc": "arc", "points": "fewer points"}
"""Groups of the variants, by the setting that makes them."""


STANDARD = (Capture(), Capture(thin=2), Capture(thin=4), Capture(thin=8), Capture(arc=0.2), Capture(points=0.1))
"""Variants of each scene in `clsplat bench captures`."""


def captured(scene: Scene, capture: Capture) -> Scene:
    """Make a variant of a scene.

    Raises
    ------
    InputError
        If too few photos remain, or the scene has no points of which a fraction could be kept.
    """
    if capture.arc:
        scene = arc(scene, capture.arc)
    if capture.thin > 1:
        scene = thinned(scene, capture.thin)
    return scene if capture.points == 1 else with_fewer_points(scene, capture.points)


def thinned(scene: Scene, every: int) -> Scene:
    """Keep every n-th training photo, from the first one. Held-out photos and points stay the same."""
    return _checked(replace(scene, train=scene.train[::every]), f"thin={every}")


def arc(scene: Scene, fraction: float) -> Scene:
    """Hold out the photos at the end of the path, and train on all others, including those held out before.

    The end of the path is the last photo by name, and as many others as are needed, those taken nearest to it first.
    Photos of a later round of the path that come near it are therefore held out, too: no training photo shows the
    scene from there.

    Parameters
    ----------
    scene : Scene
    fraction : float
        Fraction of all photos to hold out, rounded to a whole number of photos, at least one. Photos taken at the
        same place, such as the faces of a panorama, stay together.
    """
    views = sorted(scene.train + scene.test, key=lambda view: view.name)
    centres = np.array([view.camera.position for view in views])
    distances = np.linalg.norm(centres - centres[-1], axis=1)
    # Faces of a panorama have the same position apart from rounding.
    reach = np.sort(distances)[max(1, round(fraction * len(views))) - 1] + 1e-9 * scene.extent
    train = [view for view, distance in zip(views, distances, strict=True) if distance > reach]
    test = [view for view, distance in zip(views, distances, strict=True) if distance <= reach]
    return _checked(replace(scene, train=train, test=test), f"arc={fraction:g}")


def with_fewer_points(scene: Scene, fraction: float) -> Scene:
    """Keep a fraction of the sparse points, at least one, evenly spaced in their order."""
    if not len(scene.points):
        raise InputError(f"points={fraction:g}: expected a scene with sparse points to keep some of, found none")
    kept = np.floor(np.arange(max(1, int(fraction * len(scene.points)))) / fraction).astype(int)
    shown = {name: np.flatnonzero(np.isin(kept, rows)) for name, rows in scene.shown.items()}
    return replace(scene, points=scene.points[kept], colors=scene.colors[kept], shown=shown)


def _checked(scene: Scene, option: str) -> Scene:
    if len(scene.train) < PHOTOS_MIN:
        raise InputError(
            f"{option}: expected at least {PHOTOS_MIN} training photos to remain, found {len(scene.train)}"
        )
    return scene
