"""Base class of the radiance fields: their place in space, their rays, their images and their arrays."""

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.fields.pixels import Batch
from clsplat.fields.space import Space
from clsplat.scene import Color

if TYPE_CHECKING:
    from clsplat.device import Device

Array = NDArray[Any]

RENDERED_RAYS = 1024
"""Number of rays that are rendered at once. With 500 samples each, Instant-NGP takes half a gigabyte for them."""


class Rays(NamedTuple):
    """Rays on the device.

    origins, directions (R, 3) in the field's coordinates, directions of length 1; radii (R,), see `Space.radii`.
    """

    origins: Any
    directions: Any
    radii: Any


class Field(ABC):
    """A radiance field that can be trained and rendered.

    Parameters
    ----------
    space : Space
    device : Device
    seed : int
        Seed of all random numbers.

    Attributes
    ----------
    iteration : int
        Number of steps taken.
    """

    name: str
    """Name of the method, as `--method` takes it."""

    iterations: int
    """Default number of steps."""

    halved: tuple[str, ...] = ()
    """Arrays of the model that its file stores in half precision."""

    def __init__(self, space: Space, device: "Device", seed: int):
        from clsplat.ops import Launches

        self.space, self.device, self.seed = space, device, seed
        self.stages = Launches(device)
        self.iteration = 0

    @property
    @abstractmethod
    def rays(self) -> int:
        """Number of rays of the next step."""

    @abstractmethod
    def step(self, batch: Batch, progress: float) -> float:
        """Take one step of training. Returns the mean squared error.

        Parameters
        ----------
        batch : Batch
        progress : float
            Fraction of the training that is done.
        """

    @abstractmethod
    def colors(self, rays: Rays, background: Color) -> Any:
        """Colours (R, 3) of rays, on the device, in front of a background."""

    @abstractmethod
    def model(self) -> dict[str, Array]:
        """Arrays that an image depends on."""

    @abstractmethod
    def optimiser(self) -> dict[str, Array]:
        """Arrays that only further training depends on."""

    @abstractmethod
    def restore(self, arrays: dict[str, Array]) -> None:
        """Set the arrays of `model` and, if they are there, those of `optimiser`."""

    @abstractmethod
    def finish(self) -> None:
        """Round the model to the precision of its file."""

    def image(self, camera: Camera, background: Color) -> NDArray[np.float32]:
        """Render an image (H, W, 3)."""
        v, u = np.divmod(np.arange(camera.width * camera.height), camera.width)
        rgb = np.tile(np.array(background, np.float32), (len(u), 1))
        for begin in range(0, len(u), RENDERED_RAYS):
            part = slice(begin, begin + RENDERED_RAYS)
            at = camera, u[part] + 0.5, v[part] + 0.5
            origins, directions = self.space.rays(*at)
            seen = np.isfinite(directions).all(axis=1)  # a fisheye sees nothing in its corners
            if seen.any():
                arrays = (array[seen] for array in (origins, directions, self.space.radii(*at)))
                rays = Rays(*(self.device.upload("rays", array) for array in arrays))
                rgb[part][seen] = self.colors(rays, background).get()
        return rgb.reshape(camera.height, camera.width, 3)
