"""`clsplat bench viewer`: what it times, and its table."""

import json

from clsplat.bench.frame_rates import SHARES, bench_frames, frames_text
from clsplat.bench.workloads import synthetic
from clsplat.cli import main


def test_each_frame_is_another_view_at_the_resolution_it_names(device, monkeypatch):
    seen = []

    def watched(renderer, gaussians, camera):
        seen.append((camera.width, camera.viewmat.tobytes()))
        return original(renderer, gaussians, camera)

    from clsplat.bench import frame_rates

    original = frame_rates.picture
    monkeypatch.setattr(frame_rates, "picture", watched)
    results = bench_frames([synthetic("300-64x48")], device, 4, lambda name: None)
    moving = seen[: frame_rates.WARM_UP + 4]
    assert len({pose for _, pose in moving}) == len(moving)
    assert [width for width, _ in seen[len(moving) :]] == [round(64 * share) for share in SHARES for _ in range(5)]
    (row,) = results["workloads"]
    assert row["name"] == "300-64x48" and 0 < row["moving"]["share"] <= 1
    lines = frames_text(results).splitlines()
    assert f"| {1000 / row['moving']['median_ms']:.0f} |" in lines[2] and "load average" in lines[4]


def test_the_command_writes_its_results(device, tmp_path, capsys):
    main(["bench", "viewer", "--workloads", "300-64x48", "--frames", "2", "-o", str(tmp_path / "a.json")])
    text = capsys.readouterr().out
    assert text.strip() == frames_text(json.loads((tmp_path / "a.json").read_text()))
