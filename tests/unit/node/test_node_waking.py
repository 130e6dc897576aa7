"""Processors that are kept awake, as the kernel is asked to."""

from __future__ import annotations

from pathlib import Path

from pbonet.node.wire import cpu_idle_states


def held(path):
    """Return whether this process holds a file open."""
    fds = list(Path("/proc/self/fd").iterdir())
    return any(fd.exists() and fd.samefile(path) for fd in fds)


def test_asked_for_as_long_as_it_is_held(tmp_path, monkeypatch):
    device = tmp_path / "cpu_dma_latency"
    device.touch()
    monkeypatch.setattr(cpu_idle_states, "DEVICE", device)
    awake = cpu_idle_states.IdleStateLock()
    assert awake.limits == []
    assert device.read_bytes() == bytes(4)
    assert held(device)
    awake.close()
    assert not held(device)


def test_who_may_not_says_what_to_do(tmp_path, monkeypatch):
    monkeypatch.setattr(cpu_idle_states, "DEVICE", tmp_path / "none")
    (text,) = cpu_idle_states.IdleStateLock().limits
    assert "the processors sleep when they are idle" in text
    assert "No such file or directory; let the agent's user write it" in text
