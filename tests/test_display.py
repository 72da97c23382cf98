"""Display of objects in notebooks."""

import io
import re
from dataclasses import replace
from html.parser import HTMLParser
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from clsplat import display
from clsplat.camera import Camera
from clsplat.gaussians import Gaussians
from clsplat.render import render
from clsplat.scene import Scene, View
from clsplat.testing import synthetic_scene


class Balance(HTMLParser):
    """Parser that checks that tags are balanced."""

    def __init__(self):
        super().__init__()
        self.open = []

    def handle_starttag(self, tag, attrs):
        if tag != "img":
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def text_of(markup):
    """Check that HTML is well-formed; return its text."""
    parser = Balance()
    parser.feed(markup)
    parser.close()
    assert not parser.open
    return " ".join(re.sub("<[^>]*>", " ", markup).split())


@pytest.fixture
def gaussians():
    return synthetic_scene(200, sh_degree=2)[0].astype(np.float32)


def ring(count):
    """Make a scene of photos around the origin; every third one is held out."""
    views = []
    for k in range(count):
        a = 2 * np.pi * k / count
        camera = Camera.look_at((3 * np.cos(a), 3 * np.sin(a), 1), (0, 0, 0), (0, 0, 1), 40, 32, 24)
        views.append(View(f"<b>{k}.jpg", camera, np.full((24, 32, 3), 10 * k, np.uint8)))
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [99.0, 0.0, 0.0]])
    train = [v for k, v in enumerate(views) if k % 3]
    return Scene(train, views[::3], points, np.array([[1, 2, 3], [4, 5, 6], [7, 8, 9]], np.uint8))


def test_gaussians_say_what_they_are(gaussians):
    text = text_of(gaussians._repr_html_())
    assert "200 Gaussians" in text and "degree 2" in text and "float32" in text and "finite" not in text
    assert display.numbers(np.median(gaussians.means, axis=0)) in text


@pytest.mark.filterwarnings("error")
def test_gaussians_that_are_not_finite_are_counted(gaussians):
    gaussians.means[3, 1], gaussians.sh[5, 2, 0] = np.nan, np.inf
    assert "2 of them hold NaN or infinity" in text_of(gaussians._repr_html_())
    gaussians.log_scales[:] = np.nan
    assert "200 of them hold NaN" in text_of(gaussians._repr_html_())


def test_gaussians_without_values_show_themselves(gaussians):
    assert "0 Gaussians" in text_of(gaussians.take(np.zeros(200, bool))._repr_html_())
    elsewhere = Gaussians(**{k: SimpleNamespace(shape=a.shape) for k, a in gaussians.arrays().items()})
    assert text_of(elsewhere._repr_html_()) == "200 Gaussians arrays on the device"


def test_histogram_counts_what_lies_beyond_its_ends():
    values = np.concatenate([np.full(10, -5.0), np.full(20, 0.5), np.full(40, 99.0)])
    bars = re.findall(r'<rect x="(\d+)" y="[\d.]+" width="5" height="([\d.]+)"', display.histogram(values, 0, 1, "x"))
    assert bars == [("0", "12.0"), (str(6 * 16), "24.0"), (str(6 * 31), "48.0")]


def test_camera_says_where_it_stands():
    camera = Camera.look_at((0, -4, 0), (0, 0, 0), (0, 0, 1), fx=160, width=320, height=240)
    text = text_of(camera._repr_html_())
    assert "320 x 240 px" in text and "90° x 74°" in text
    assert "position 0, -4, 0" in text.replace("-0", "0") and "viewing direction 0, 1, 0" in text.replace("-0", "0")


def test_scene_shows_its_photos_and_cameras():
    scene = ring(12)
    markup = scene._repr_html_()
    text = text_of(markup)
    assert "8 to train on, 4 held out" in text and "32 x 24" in text and "offset" not in text
    assert markup.count("<img") == 8 and "<b>" not in markup and "&lt;b&gt;1.jpg" in markup
    assert markup.count('fill="none"') == 4
    assert "rgb(1,2,3)" in markup and "rgb(7,8,9)" not in markup  # far outside of the plan
    moved = replace(scene, offset=np.array([5e5, 0.0, 0.0]))
    assert "offset 5e+05, 0, 0" in text_of(moved._repr_html_())


def test_scene_draws_each_camera_where_it_stands():
    markup = ring(12)._repr_html_()
    marks = re.findall(r'x1="(.*?)" y1="(.*?)" x2="(.*?)" y2="(.*?)"', markup)
    start, end = np.split(np.array(marks, dtype=float), 2, axis=1)
    arms = start - display.PLAN / 2
    assert np.linalg.norm(arms, axis=1) == pytest.approx(display.PLAN / 2 / 1.25, abs=0.2)
    # Every camera looks at the centre.
    assert ((end - start) * arms).sum(axis=1) == pytest.approx(
        -np.linalg.norm(arms, axis=1) * np.linalg.norm(end - start, axis=1), rel=0.02
    )


def test_scene_without_photos_or_points_shows_itself():
    empty = Scene([], [], np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    assert "0 to train on, 0 held out" in text_of(empty._repr_html_())
    text_of(replace(ring(9), points=empty.points, colors=empty.colors)._repr_html_())
    text_of(replace(ring(3), test=[])._repr_html_())
    text_of(replace(ring(9), train=[])._repr_html_())


@pytest.mark.filterwarnings("error")
def test_rendering_is_its_image():
    gaussians, camera = synthetic_scene(20)
    rendering = render(gaussians, camera, device="reference")
    rendering.rgb = rendering.rgb * 2  # beyond 1
    rendering.rgb[0, 0] = np.nan
    shown = np.asarray(Image.open(io.BytesIO(rendering._repr_png_())))
    expected = np.rint(255 * np.clip(rendering.rgb, 0, 1))
    expected[0, 0] = 0
    np.testing.assert_array_equal(shown, expected)
