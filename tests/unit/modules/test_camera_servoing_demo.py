"""The example of visual servoing by pictures, in virtual time."""

from __future__ import annotations

import importlib.util
import re
from typing import Any

import pytest
from drawn_pictures import EXAMPLE, drawn_camera


@pytest.fixture(scope="module")
def demo() -> Any:
    drawn_camera(width=32, height=24).close()
    spec = importlib.util.spec_from_file_location("camera_demo", EXAMPLE / "demo.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_the_ball_is_followed_and_what_was_seen_is_shown(
    demo: Any, tmp_path: Any, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A second and a half of each camera is enough: the ball gains speed in it."""
    monkeypatch.setattr(demo, "ROUND", 1.6)
    monkeypatch.setattr(demo, "SETTLED", 0.5)
    monkeypatch.setattr(demo, "KEPT", (1.0,))
    pytest.importorskip("matplotlib", reason="pip install 'pbonet[plot]'")
    plot, pictures = tmp_path / "plot.png", tmp_path / "pictures"
    demo.main(["--sim", "--plot", str(plot), "--pictures", str(pictures)])
    out = capsys.readouterr().out
    found = re.findall(r"^(simulated|drawn) +([\d.]+) +([\d.]+)$", out, re.MULTILINE)
    assert [one[0] for one in found] == ["simulated", "drawn"]
    for _, rms, far in found:
        assert 0.5 < float(rms) < float(far) < 30.0, "followed, and not by knowing it"
    assert float(re.search(r"pictures +([\d.]+) per second", out)[1]) > 20.0
    assert "cycles missed: none" in out
    (picture,) = pictures.iterdir()
    for file in (plot, picture):
        assert file.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
