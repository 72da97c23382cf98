"""Evaluation of a small scene by the float64 twins: figures, files and the page."""

import json
import sys
from dataclasses import replace
from html.parser import HTMLParser
from urllib.parse import unquote

import numpy as np
import pytest
from PIL import Image

from clsplat import metrics
from clsplat.camera import Camera
from clsplat.config import RenderConfig
from clsplat.errors import InputError
from clsplat.evaluate import METRICS, evaluate, mean_metrics
from clsplat.gaussians import Gaussians
from clsplat.render import render
from clsplat.renderer import Renderer
from clsplat.scene import View

REFERENCE = Renderer("reference")
WHITE = (1.0, 1.0, 1.0)


@pytest.fixture
def gaussians():
    rng = np.random.default_rng(0)
    n = 20
    return Gaussians(
        means=rng.uniform(-1, 1, (n, 3)),
        log_scales=rng.uniform(-2, -1, (n, 3)),
        quats=rng.normal(size=(n, 4)),
        logit_opacities=rng.normal(size=n),
        sh=rng.normal(size=(n, 4, 3)),
    ).astype(np.float32)


def make_views(gaussians, noise, **options):
    """Photos of the Gaussians themselves, each with noise of its own strength in steps of 8 bits."""
    rng = np.random.default_rng(1)
    views = []
    for k, strength in enumerate(noise):
        camera = Camera.look_at([np.sin(k), 0.3, -4 * np.cos(k)], [0, 0, 0], [0, -1, 0], 30.0, 32 + k, 24)
        photo = metrics.to_uint8(render(gaussians, camera, **options).rgb).astype(int)
        photo += np.rint(rng.normal(scale=strength, size=photo.shape)).astype(int)
        views.append(View(f"{k}.jpg", camera, np.clip(photo, 0, 255).astype(np.uint8)))
    return views


def read(path):
    return np.array(Image.open(path).convert("RGB"))


def test_figures_are_those_of_the_files(gaussians, tmp_path):
    views = make_views(gaussians, [5, 20, 10])
    result = evaluate(gaussians, views, tmp_path / "new" / "out", REFERENCE)
    out = tmp_path / "new" / "out"
    assert json.loads((out / "metrics.json").read_text()) == result
    assert list(result) == ["mean", "num_gaussians", "sh_degree", "mode", "resolution", "device", "views"]
    assert (result["num_gaussians"], result["sh_degree"], result["mode"]) == (20, 1, "classic")
    assert result["resolution"] == "32x24, 33x24, 34x24"
    for view, record in zip(views, result["views"], strict=True):
        truth, image = read(out / record["truth"]), read(out / record["render"])
        np.testing.assert_array_equal(truth, view.image)
        assert (record["name"], record["width"], record["height"]) == (view.name, view.camera.width, 24)
        for metric in (metrics.psnr, metrics.psnr_fitted, metrics.ssim, metrics.flip):
            assert record[metric.__name__] == metric(image, truth)
        # The photo was the render plus noise: nothing but the noise is left.
        assert np.abs(image.astype(int) - truth).mean() < 20
    psnrs = [record["psnr"] for record in result["views"]]
    assert psnrs[0] > psnrs[2] > psnrs[1]
    assert result["mean"]["psnr"] == pytest.approx(np.mean(psnrs), rel=1e-12)
    assert mean_metrics(gaussians, views, REFERENCE) == {key: result["mean"][key] for key in ("psnr", "ssim")}
    chosen = mean_metrics(gaussians, views, REFERENCE, metrics=(metrics.flip, metrics.ssim))
    assert chosen == {key: result["mean"][key] for key in ("flip", "ssim")}


def test_mode_background_and_mask_are_passed_on(gaussians, tmp_path):
    config = RenderConfig(mode="antialiased")
    (view,) = make_views(gaussians, [0], config=config, background=WHITE)
    assert evaluate(gaussians, [view], tmp_path, Renderer("reference", config, WHITE))["mean"]["psnr"] is None
    assert evaluate(gaussians, [view], tmp_path, Renderer("reference", config))["mean"]["psnr"] < 40
    assert evaluate(gaussians, [view], tmp_path, Renderer("reference", background=WHITE))["mean"]["psnr"] < 60
    photo, mask = view.image.copy(), np.ones((24, 32), dtype=bool)
    photo[:, :10], mask[:, :10] = 255 - photo[:, :10], False
    masked = View(view.name, view.camera, photo, mask)
    assert evaluate(gaussians, [masked], tmp_path, Renderer("reference", config, WHITE))["mean"]["psnr"] is None
    assert mean_metrics(gaussians, [masked], Renderer("reference", config, WHITE))["psnr"] == np.inf


def test_equal_images_are_written_as_valid_json(gaussians, tmp_path):
    result = evaluate(gaussians, make_views(gaussians, [0, 9]), tmp_path, REFERENCE)
    assert result["views"][0]["psnr"] is None and result["views"][1]["psnr"] > 20
    assert result["mean"]["psnr"] is None
    assert "Infinity" not in (tmp_path / "metrics.json").read_text()
    assert ">∞" in (tmp_path / "index.html").read_text(encoding="utf-8")


class Page(HTMLParser):
    """Links, texts of headings, and the order of the cards."""

    def __init__(self, text):
        super().__init__()
        self.links, self.cards, self.headings, self.open = [], [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        attributes = dict(attributes)
        self.links += [attributes[key] for key in ("src", "href") if key in attributes]
        if tag == "article":
            self.cards.append(attributes["id"])
        self.open.append(tag)

    def handle_data(self, data):
        if self.open and self.open[-1] == "h3" and data.strip():
            self.headings.append(data)

    def handle_endtag(self, tag):
        self.open.append("/" + tag)


def test_the_page_links_to_its_pictures_worst_first(gaussians, tmp_path):
    views = make_views(gaussians, [5, 20, 10])
    names = ["a/<b>&\"x'.jpg", "../.b c#1?.jpg", "b_c_1.png"]
    views = [View(name, view.camera, view.image) for name, view in zip(names, views, strict=True)]
    result = evaluate(gaussians, views, tmp_path, REFERENCE)
    page = Page((tmp_path / "index.html").read_text(encoding="utf-8"))
    assert page.cards == ["view-1", "view-2", "view-0"]
    assert page.headings == [names[1], names[2], names[0]]
    local = [link for link in page.links if link.startswith("#")]
    pictures = {unquote(link) for link in page.links if not link.startswith("#")}
    assert set(local) == {"#view-0", "#view-1", "#view-2"}
    assert len(pictures) == 9
    for link in pictures:
        assert not (tmp_path / link).name.startswith(".")
        assert (tmp_path / link).resolve().is_relative_to(tmp_path) and (tmp_path / link).is_file()
    text = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert "<b>" not in text and f"{result['mean']['psnr']:.2f}" in text and "http" not in text


def test_views_of_one_name_do_not_overwrite_each_other(gaussians, tmp_path):
    views = make_views(gaussians, [5, 20, 10, 7])
    names = ["a/1.jpg", "A_1.png", "a_1.JPG", "照片.jpg"]
    views = [View(name, view.camera, view.image) for name, view in zip(names, views, strict=True)]
    records = evaluate(gaussians, views, tmp_path, REFERENCE)["views"]
    assert len({record["truth"].casefold() for record in records}) == 4
    assert records[3]["truth"] == "truth/照片.png"
    for view, record in zip(views, records, strict=True):
        np.testing.assert_array_equal(read(tmp_path / record["truth"]), view.image)


def test_long_names_are_cut_to_what_a_file_system_allows(gaussians, tmp_path):
    views = make_views(gaussians, [5, 20])
    views = [View("照" * 80 + f"{k}.jpg", view.camera, view.image) for k, view in enumerate(views)]
    records = evaluate(gaussians, views, tmp_path, REFERENCE)["views"]
    for view, record in zip(views, records, strict=True):
        np.testing.assert_array_equal(read(tmp_path / record["truth"]), view.image)


def test_names_need_not_be_text(gaussians, tmp_path):
    """Names of files are bytes; those that are not UTF-8 come with surrogates (PEP 383)."""
    (view,) = make_views(gaussians, [5])
    result = evaluate(gaussians, [replace(view, name="fa\udce7ade.jpg")], tmp_path, REFERENCE)
    assert json.loads((tmp_path / "metrics.json").read_text()) == result
    assert "fa?ade.jpg" in (tmp_path / "index.html").read_text(encoding="utf-8")


def test_the_same_again_is_the_same_bytes(gaussians, tmp_path):
    views = make_views(gaussians, [5, 20])
    for out in ("one", "two"):
        evaluate(gaussians, iter(views), tmp_path / out, REFERENCE)
    files = sorted(p.relative_to(tmp_path / "one") for p in (tmp_path / "one").rglob("*") if p.is_file())
    assert len(files) == 2 + 2 * 3
    for file in files:
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes()


def test_without_flip(gaussians, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    result = evaluate(gaussians, make_views(gaussians, [5]), tmp_path, REFERENCE)
    assert result["mean"]["flip"] is None and result["views"][0]["flip"] is None
    assert "FLIP" not in (tmp_path / "index.html").read_text(encoding="utf-8")


def test_what_is_refused(gaussians, tmp_path):
    (view,) = make_views(gaussians, [5])
    with pytest.raises(InputError, match="at least one view"):
        evaluate(gaussians, [], tmp_path, REFERENCE)
    wrong = View("x.jpg", view.camera, view.image[:-1])
    with pytest.raises(InputError, match=r"x\.jpg: expected a photo of its camera's size, \(24, 32, 3\)"):
        evaluate(gaussians, [wrong], tmp_path, REFERENCE)
    assert not (tmp_path / "metrics.json").exists()
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"cannot create .*file: Not a directory"):
        evaluate(gaussians, [view], tmp_path / "file", REFERENCE)


def test_more_metrics_where_they_are_asked_for(gaussians, tmp_path):
    """As LPIPS: in the figures and on the page."""

    def lpips(image, truth, mask):
        return 0.25

    views = make_views(gaussians, [0, 5], device="reference")
    plain = evaluate(gaussians, views, tmp_path / "plain", REFERENCE)
    more = evaluate(gaussians, views, tmp_path / "more", REFERENCE, (*METRICS, lpips))
    assert "lpips" not in plain["mean"] and more["mean"] == {**plain["mean"], "lpips": 0.25}
    assert [view["lpips"] for view in more["views"]] == [0.25, 0.25]
    pages = [(tmp_path / name / "index.html").read_text(encoding="utf-8") for name in ("plain", "more")]
    assert "LPIPS" not in pages[0] and "Mean LPIPS" in pages[1]
