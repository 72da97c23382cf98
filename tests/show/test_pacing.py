"""Times and resolutions of frames by hand: steps of refinement, and the resolution while the camera moves."""

import pytest

from clsplat.camera import Camera
from clsplat.show.pacing import FRAME_TIME, STILL_AFTER, Client, Shown

CAMERA = Camera.look_at((0, 0, -5), (0, 0, 0), (0, -1, 0), 50, 64, 48)


def client(share: float, camera: Camera = CAMERA, version: int = 0) -> Client:
    """A browser that shows a frame which took 1 s and was complete at 0 s, when its camera moved last."""
    return Client(None, CAMERA, share=0.3, shown=Shown(camera, share, 0, version, 0.0, 1.0))


def test_a_still_frame_is_refined_in_steps() -> None:
    assert [client(share).share_due(STILL_AFTER, 0, 0) for share in (0.25, 0.5, 0.6, 1.0)] == [0.5, 1.0, 1.0, 0.0]
    assert client(0.25).share_due(0.9 * STILL_AFTER, 0, 0) == 0


def test_what_the_user_changes_is_shown_at_once() -> None:
    moved = Camera.look_at((0, 1, -5), (0, 0, 0), (0, -1, 0), 50, 64, 48)
    assert client(1.0, moved).share_due(0, 0, 0) == client(1.0).share_due(0, 1, 0) == 0.3
    assert Client(None, CAMERA).share_due(0, 0, 0) == 0.25
    assert Client(None).share_due(9, 0, 0) == 0, "its camera is not known yet"


def test_a_new_scene_waits_for_ten_times_the_time_of_a_frame() -> None:
    assert [client(1.0).share_due(now, 0, 1) for now in (9.9, 10.1)] == [0, 1]
    assert client(1.0).share_due(99, 0, 0) == 0, "the scene is the same"


@pytest.mark.parametrize(
    ("share", "times", "expected"),
    [
        (0.5, 1, 0.5),
        (0.5, 2, 0.5 / 2**0.5),  # the time is in proportion to the pixels
        (0.5, 0.25, 1.0),
        (0.3, 0.01, 0.6),  # at most twice the resolution
        (1.0, 100, 0.5),  # at least half of it
        (0.3, 100, 0.25),
        (0.8, 0.25, 1.0),
    ],
)
def test_the_resolution_follows_the_time(share: float, times: float, expected: float) -> None:
    one = Client(None, share=share)
    one.adapt(times * FRAME_TIME)
    assert one.share == pytest.approx(expected)
