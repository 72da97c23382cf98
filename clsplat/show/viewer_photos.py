"""The photos in the viewer: their cameras as outlines, a list, and a comparison with the render."""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from clsplat.camera import Camera
from clsplat.scene import Color
from clsplat.show.browser_cameras import target_of, whole_view, wxyz_of
from clsplat.show.viewer_panel import Panel
from clsplat.show.viewer_tasks import Task
from clsplat.show.viewer_thumbnails import Thumbnails, scaled

if TYPE_CHECKING:
    from clsplat.scene import View

OUTLINE_SHARE = 0.02
"""Size of a camera's outline, as a fraction of the cameras' mean distance from the focus. Some fifty outlines of this
size do not hide the scene."""

OUTLINE_COLOR = (255, 140, 0)
"""Colour of the nearest outlines, RGB. It is rare in photos."""

FADES = (1.0, 0.8, 0.6, 0.45)
"""Opacities of outlines, from near to far. viser's lines have none: their colour is mixed with the background's.
Below these, lines are no longer orange in front of a scene that covers the background."""

FADE_REACH = 2.0
"""Distance at which outlines are faintest, in mean distances of the cameras from the focus."""

PANEL_WIDTH = 320
"""Longer edge of the selected photo in the panel, px."""

COMPARISONS = ("off", "overlay", "beside")
"""Comparisons of the selected photo with the render: none, the photo over the render, or to the left of a line."""

SAME_ANGLE = 1e-3
"""Largest difference of two rotation matrices, per entry, up to which views are the same. Half a pixel of a window of
1000 pixels at a right angle."""


class Photos:
    """Maker of the outlines and the inputs.

    Parameters
    ----------
    panel : Panel
    views : list of View
        At least one.
    focus : (3,)
        Point around which a view turns after a jump to a camera.
    background : callable
        Returns the colour behind the scene, into which outlines fade.
    changed : callable
        Called after each change that a frame shows.
    later : callable
        Takes a function that the owner of the device calls, and whose steps run between frames.
    zoomed : callable
        Called with the vertical field of view, radians, after a jump to a camera.
    """

    def __init__(
        self,
        panel: Panel,
        views: "list[View]",
        focus: NDArray[np.float64],
        background: Callable[[], Color],
        changed: Callable[[], None],
        later: Callable[[Task], None],
        zoomed: Callable[[float], None],
    ):
        self._views, self._focus = views, focus
        self._background, self._changed, self._zoomed = background, changed, zoomed
        self._centres = np.array([view.camera.position for view in views])
        self._distance = max(float(np.linalg.norm(self._centres - focus, axis=1).mean()), 1e-9)
        self._index = {view.name: i for i, view in enumerate(views)}
        self._list = panel.dropdown("Photo", [view.name for view in views], self._chosen)
        panel.button("Previous", lambda event: self._step(event, -1))
        panel.button("Next", lambda event: self._step(event, 1))
        self._shown = panel.gui.add_image(self._small(), format="jpeg")
        self._comparison = panel.dropdown("Compare", COMPARISONS, lambda _: changed())
        self._share = panel.slider("Photo's share", (0, 100), 1, 50, lambda _: changed())
        self._visible = panel.checkbox("Cameras", True, lambda _: changed())
        self._grid = Thumbnails(panel, views, self._select, later)

    @property
    def selected(self) -> "View":
        """The photo that the list shows."""
        return self._views[self._index[self._list.value]]

    def _small(self) -> NDArray[np.uint8]:
        return scaled(self.selected.image, PANEL_WIDTH, PANEL_WIDTH)

    def _chosen(self, event: Any) -> None:
        self._shown.image = self._small()
        self._grid.mark(self._index[self._list.value])
        if event.client is not None:
            self.jump(event.client, self.selected.camera)
        self._changed()

    def _step(self, event: Any, by: int) -> None:
        index = (self._index[self._list.value] + by) % len(self._views)
        self._select(event.client, index)

    def _select(self, handle: Any, index: int) -> None:
        self._list.value = self._views[index].name  # calls `_chosen`, but without a browser
        self.jump(handle, self._views[index].camera)

    def outlines(self, handle: Any) -> dict[int, Any]:
        """Add the outlines of the cameras to a browser's scene; their handles by the index of the view."""
        result = {}
        for index, view in enumerate(self._views):
            camera = view.camera
            outline = handle.scene.add_camera_frustum(
                f"/cameras/{view.name}",
                fov=2 * math.atan(camera.height / camera.fy / 2),
                aspect=camera.width / camera.fx * camera.fy / camera.height,
                scale=OUTLINE_SHARE * self._distance,
                thickness=1.0,
                thickness_units="screen",
                color=OUTLINE_COLOR,
                wxyz=wxyz_of(camera),
                position=camera.position,
            )

            @outline.on_click
            async def _(event: Any, index: int = index) -> None:
                self._select(event.client, index)

            result[index] = outline
        return result

    def fade(self, outlines: dict[int, Any], camera: Camera) -> None:
        """Give outlines the colours for a browser's camera, and hide the one that it looks through."""
        away = np.linalg.norm(self._centres - camera.position, axis=1)
        steps = np.clip(away / (FADE_REACH * self._distance) * len(FADES), 0, len(FADES) - 1).astype(int)
        near = away < 2 * OUTLINE_SHARE * self._distance
        behind = self._background()
        for index, outline in outlines.items():
            visible = bool(self._visible.value and not near[index])
            if outline.visible != visible:
                outline.visible = visible
            share = FADES[steps[index]]
            mixed = tuple(
                round(share * full + (1 - share) * 255 * other)
                for full, other in zip(OUTLINE_COLOR, behind, strict=True)
            )
            if visible and tuple(outline.color) != mixed:
                outline.color = mixed

    def jump(self, handle: Any, camera: Camera) -> None:
        """Move a browser's view to a camera."""
        with handle.atomic():
            handle.camera.position = camera.position
            handle.camera.look_at = target_of(camera, self._focus)
            handle.camera.wxyz = wxyz_of(camera)
            handle.camera.fov = field = whole_view(camera, handle.camera.aspect)
        self._zoomed(field)

    def compared(self, frame: NDArray[np.uint8], camera: Camera) -> NDArray[np.uint8]:
        """A browser's frame with the selected photo, if the view is that of its camera and a comparison is chosen."""
        photo = self.selected
        if self._comparison.value == COMPARISONS[0] or not _same_view(photo.camera, camera):
            return frame
        return blended(frame, camera, photo.image, photo.camera, self._comparison.value, self._share.value / 100)


def _same_view(photo: Camera, window: Camera) -> bool:
    near = np.linalg.norm(photo.position - window.position) <= SAME_ANGLE * (1 + np.linalg.norm(photo.position))
    turned = np.abs(photo.viewmat[:3, :3] - window.viewmat[:3, :3]).max() > SAME_ANGLE
    return bool(photo.model == "pinhole" and near and not turned)


def blended(
    frame: NDArray[np.uint8],
    window: Camera,
    image: NDArray[np.uint8],
    photo: Camera,
    comparison: str,
    share: float,
) -> NDArray[np.uint8]:
    """Combine a frame and a photo that were taken from the same place in the same direction.

    Parameters
    ----------
    frame : (H, W, 3) uint8
    window : Camera
        Of the frame; a pinhole.
    image : (H', W', 3) uint8
    photo : Camera
        Of the image; a pinhole.
    comparison : str
        "overlay" mixes the two, "beside" shows the photo to the left.
    share : float
        Weight of the photo, or the fraction of its width that is shown, 0 to 1.
    """
    height, width = frame.shape[:2]
    x, y = photo.fx / window.fx, photo.fy / window.fy
    # Pillow maps pixels of the result to pixels of the image, both from the corner of the upper left one.
    mapping = (x, 0, photo.cx - window.cx * x, 0, y, photo.cy - window.cy * y)
    opaque = np.dstack([image, np.full(image.shape[:2], 255, np.uint8)])
    taken = Image.fromarray(opaque).transform(
        (width, height), Image.Transform.AFFINE, mapping, Image.Resampling.BILINEAR
    )
    pixels = np.asarray(taken)
    inside = pixels[:, :, 3:] == 255
    if comparison == "overlay":
        mixed = np.rint((1 - share) * frame + share * pixels[:, :, :3])
        return np.where(inside, mixed, frame).astype(np.uint8)
    left = window.cx - photo.cx / x
    line = left + share * photo.width / x
    columns = np.arange(width)[None, :, None] + 0.5
    result = np.where(inside & (columns < line), pixels[:, :, :3], frame)
    result[:, np.abs(columns[0, :, 0] - line) < 1] = 255
    return np.asarray(result, np.uint8)
