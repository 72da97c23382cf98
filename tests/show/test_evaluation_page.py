"""The page of an evaluation, read back from its file."""

import re

from clsplat.show.evaluation_page import write_page


def test_page_escapes_texts_and_puts_equal_images_last(tmp_path):
    views = [
        {"name": f"<{k}>", "psnr": psnr, "psnr_fitted": psnr, "ssim": 0.5, "flip": None, "width": 4, "height": 3}
        | {kind: f'{kind}/"{k}" #<.png' for kind in ("truth", "render", "difference")}
        for k, psnr in enumerate([None, 31.25, 20.0, -1.5])
    ]
    result = {
        "mean": {"psnr": None, "psnr_fitted": None, "ssim": 0.5, "flip": None},
        "num_gaussians": 1234567,
        "sh_degree": 2,
    }
    result |= {"mode": "classic", "resolution": "4x3", "device": "<PoCL> & CPU", "views": views}
    write_page(tmp_path / "index.html", result)
    text = (tmp_path / "index.html").read_text(encoding="utf-8")
    positions = [text.index(f"<h3>&lt;{k}&gt;</h3>") for k in (3, 2, 1, 0)]
    assert positions == sorted(positions)
    assert "&lt;PoCL&gt; &amp; CPU" in text and "1,234,567 Gaussians" in text
    assert 'href="truth/%220%22%20%23%3C.png"' in text
    assert "<0>" not in text and "FLIP" not in text
    assert re.findall(r"height:([-\d.]+)%", text) == ["100.0", "100.0", "64.0", "0.0"]
