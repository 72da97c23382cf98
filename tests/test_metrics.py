"""Metrics against scikit-image, against their definitions written out, and on what must be refused."""

import math
import subprocess
import sys
import types

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.metrics import flip, lpips, lpips_network, psnr, psnr_fitted, ssim, to_uint8

METRICS = [psnr, psnr_fitted, ssim, flip]


@pytest.fixture
def pair():
    rng = np.random.default_rng(0)
    truth = rng.integers(0, 256, size=(40, 50, 3), dtype=np.uint8)
    noise = rng.normal(scale=20, size=truth.shape)
    return np.clip(truth + noise, 0, 255).astype(np.uint8), truth


def ssim_by_definition(a, b):
    """Mean SSIM as Wang et al. define it: at each pixel the weighted moments of its 11x11 window, zeros outside."""
    a, b = a / 255, b / 255
    y, x = np.mgrid[-5:6, -5:6]
    w = np.exp(-(x**2 + y**2) / (2 * 1.5**2))
    w /= w.sum()
    total = 0.0
    for c in range(3):
        pa, pb = np.pad(a[..., c], 5), np.pad(b[..., c], 5)
        for i in range(a.shape[0]):
            for j in range(a.shape[1]):
                wa, wb = pa[i : i + 11, j : j + 11], pb[i : i + 11, j : j + 11]
                ma, mb = (w * wa).sum(), (w * wb).sum()
                va, vb = (w * (wa - ma) ** 2).sum(), (w * (wb - mb) ** 2).sum()
                cov = (w * (wa - ma) * (wb - mb)).sum()
                total += (2 * ma * mb + 1e-4) * (2 * cov + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4))
    return total / a.size


def test_rounding_to_8_bits():
    values = np.array([-1, 0, 0.4999 / 255, 0.5001 / 255, 254.4 / 255, 254.6 / 255, 1, 7, 0.5]).reshape(1, 3, 3)
    assert to_uint8(values).ravel().tolist() == [0, 0, 0, 1, 254, 255, 255, 255, 128]
    assert to_uint8(values.astype(np.float32)).dtype == np.uint8


def test_psnr_against_scikit_image(pair):
    from skimage.metrics import peak_signal_noise_ratio

    image, truth = pair
    assert psnr(image, truth) == pytest.approx(peak_signal_noise_ratio(truth, image), rel=1e-12)
    # A difference of one step everywhere: 20 log10(255).
    assert psnr(np.full((4, 5, 3), 8, np.uint8), np.full((4, 5, 3), 9, np.uint8)) == pytest.approx(48.1308, abs=1e-4)
    assert psnr(truth, truth) == math.inf


def test_fitted_psnr_forgives_an_affine_map_of_the_colours_and_nothing_else(pair):
    image, truth = pair
    mask = np.zeros(truth.shape[:2], bool)
    mask[:30] = True
    calm = 60 + truth // 3  # no channel is clamped by the map
    mapped = calm / 255 @ np.array([[0.9, 0.05, 0], [0.05, 1.1, 0], [0, 0.1, 0.8]]) + [0.05, -0.02, 0]
    outside = np.where(mask[..., None], mapped, 0.5)
    for other in (mapped, outside):
        assert psnr(other, calm, mask) < 30
        # Two roundings to 8 bits, whose errors have a variance of 1/12 each: 48.1 dB + 10 log10(12 / 2) = 55.9 dB.
        assert psnr_fitted(other, calm, mask) > 54
    assert psnr_fitted(outside, calm) < 30
    # Noise is nothing that a map explains.
    assert psnr(image, truth) <= psnr_fitted(image, truth) < psnr(image, truth) + 0.5
    assert math.isfinite(psnr_fitted(np.zeros_like(truth), truth))


def test_ssim_against_its_definition(pair):
    image, truth = (x[:14, :17] for x in pair)
    # float64 on both sides; the difference of moments loses three digits.
    assert ssim(image, truth) == pytest.approx(ssim_by_definition(image, truth), rel=1e-12)
    assert ssim(truth, truth) == pytest.approx(1, abs=1e-12)


def test_ssim_against_scikit_image_away_from_the_borders(pair):
    from skimage.metrics import structural_similarity

    # Within a black frame as wide as the window's half, their mirrored borders and our zeros are the same.
    image, truth = (np.pad(x, ((10, 10), (10, 10), (0, 0))) for x in pair)
    _, theirs = structural_similarity(
        truth, image, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, channel_axis=2, full=True
    )
    assert ssim(image, truth) == pytest.approx(theirs.mean(), rel=1e-9)


def test_flip_behaves_as_an_error(pair):
    pytest.importorskip("flip_evaluator")
    image, truth = pair
    assert flip(truth, truth) == 0
    closer = ((image.astype(float) + truth) / 2).astype(np.uint8)
    assert 0 < flip(closer, truth) < flip(image, truth) < 1
    # The largest error FLIP knows, by its definition: complementary primaries over a whole image.
    green, blue = np.zeros((32, 32, 3)), np.zeros((32, 32, 3))
    green[..., 1] = blue[..., 2] = 1
    assert flip(green, blue) > 0.9


def test_flip_is_none_where_it_is_not_installed(pair, monkeypatch):
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    assert flip(*pair) is None


@pytest.mark.parametrize("metric", METRICS)
def test_floats_count_as_their_8_bits(pair, metric):
    image, truth = pair
    rng = np.random.default_rng(1)
    nearby = (image + rng.uniform(-0.49, 0.49, size=image.shape)) / 255
    assert metric(nearby.astype(np.float32), truth) == metric(image, truth)


@pytest.mark.parametrize("metric", METRICS)
def test_masked_pixels_do_not_count(pair, metric):
    image, truth = pair
    mask = np.zeros(truth.shape[:2], dtype=bool)
    mask[8:30, 10:40] = True
    changed = image.copy()
    changed[~mask] = 255 - changed[~mask]
    assert metric(changed, truth, mask) == metric(image, truth, mask)
    assert metric(image, truth, ~np.zeros_like(mask)) == metric(image, truth)
    if metric(image, truth) is not None:
        assert metric(image, truth, mask) != metric(image, truth)


def test_masked_psnr_is_that_of_the_crop(pair):
    image, truth = pair
    mask = np.zeros(truth.shape[:2], dtype=bool)
    mask[8:30, 10:40] = True
    assert psnr(image, truth, mask) == pytest.approx(psnr(image[8:30, 10:40], truth[8:30, 10:40]), rel=1e-12)


@pytest.mark.parametrize("metric", METRICS)
def test_what_is_refused(pair, metric):
    image, truth = pair
    nan = image / 255
    nan[3, 4, 1] = np.nan
    for bad, message in [
        (nan, "finite"),
        (image[:-1], r"truth's shape \(40, 50, 3\)"),
        (image[..., 0], r"\(H, W, 3\)"),
        (image[:0], r"\(H, W, 3\)"),
        (image.astype(np.int64), "uint8 or floats"),
    ]:
        with pytest.raises(InputError, match=message):
            metric(bad, truth)
    for mask in (np.zeros((40, 50), bool), np.ones((40, 49), bool), np.ones((40, 50))):
        with pytest.raises(InputError, match="mask"):
            metric(image, truth, mask)


@pytest.mark.parametrize(("metric", "best"), [(ssim, 1), (flip, 0)])
def test_the_mean_is_over_the_mask(pair, metric, best):
    if metric is flip:
        pytest.importorskip("flip_evaluator")
    image = pair[1].copy()
    image[18:22, 23:27] = 0
    mask = np.zeros(image.shape[:2], dtype=bool)
    mask[3:37, 8:42] = True
    # All differences lie in the mask, the windows of both metrics included: only the number of pixels changes.
    whole, masked = (metric(image, pair[1], m) - best for m in (None, mask))
    assert masked * mask.sum() == pytest.approx(whole * mask.size, rel=1e-6)


class Tensor:
    """What `lpips` uses of a tensor."""

    def __init__(self, array):
        self.array = array

    def detach(self):
        return self

    def numpy(self):
        return self.array


@pytest.fixture
def lpips_installed(tmp_path, monkeypatch):
    """Modules in the place of lpips and torch: the distance is the mean absolute difference, of inputs in [-1, 1]."""

    class LPIPS:
        def __init__(self, net, spatial, verbose):
            assert (net, verbose) == ("alex", False)
            self.spatial = spatial

        def eval(self):
            return self

        def __call__(self, a, b):
            assert a.array.dtype == np.float32 and a.array.shape == (1, 3, 40, 50) and np.abs(a.array).max() <= 1
            off = np.abs(a.array - b.array).mean(axis=1, keepdims=True)
            return Tensor(off if self.spatial else off.mean(axis=(2, 3), keepdims=True))

    hub = types.SimpleNamespace(get_dir=lambda: str(tmp_path))
    monkeypatch.setitem(sys.modules, "torch", types.SimpleNamespace(hub=hub, from_numpy=Tensor))
    monkeypatch.setitem(sys.modules, "lpips", types.SimpleNamespace(LPIPS=LPIPS))
    lpips_network.cache_clear()
    yield tmp_path
    lpips_network.cache_clear()


def test_lpips_is_that_of_its_package(pair, lpips_installed):
    (lpips_installed / "checkpoints").mkdir()
    (lpips_installed / "checkpoints" / "alexnet-owt-7be5be79.pth").touch()
    off = 2 * np.abs(pair[0].astype(float) - pair[1]) / 255
    assert lpips(*pair) == pytest.approx(off.mean(), rel=1e-5)
    mask = np.zeros(off.shape[:2], bool)
    mask[5:9, 7:30] = True
    assert lpips(*pair, mask) == pytest.approx(off[mask].mean(), rel=1e-5)
    assert lpips(pair[1], pair[1]) == 0


def test_lpips_downloads_no_weights(pair, lpips_installed):
    with pytest.raises(InputError, match=r"expected the weights of AlexNet, alexnet-owt-\*\.pth, in .*, found none"):
        lpips(*pair)


def test_lpips_names_the_package_that_is_missing(pair, monkeypatch):
    lpips_network.cache_clear()
    monkeypatch.setitem(sys.modules, "lpips", None)
    with pytest.raises(InputError, match=r"lpips: expected the package lpips, found none .* pip install"):
        lpips(*pair)


def test_torch_is_imported_by_lpips_alone():
    code = "import sys, clsplat, clsplat.evaluate, clsplat.metrics, clsplat.cli; print('torch' in sys.modules)"
    assert (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "False\n"
    )
