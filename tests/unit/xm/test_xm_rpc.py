"""Errors of agents: where they are said to be, and what is said of who is silent."""

from __future__ import annotations

import pytest

from pbonet.errors import NodeError, ProtocolError
from pbonet.xm.net import codec, credentials, messages as m, pki, unreachable_reason
from pbonet.xm.net.credentials import Role
from pbonet.xm.net.rpc import placed


@pytest.mark.parametrize(
    ("where", "whole"),
    [
        ("", "arm0"),
        ("arm0", "arm0"),
        ("arm0/pid", "arm0/pid"),
        ("pid.rmod:3:1", "arm0/pid.rmod:3:1"),
        ("/lib/pid.py:12", "arm0:/lib/pid.py:12"),
        ("arm0:/lib/pid.py:12", "arm0:/lib/pid.py:12"),
        ("charm0/x", "arm0/charm0/x"),
    ],
)
def test_place_of_an_error_begins_with_its_rtpu(where, whole):
    assert placed("arm0", NodeError("it failed", where=where)).where == whole


@pytest.mark.parametrize(
    "message", [m.Hello(id="i", client="anna"), m.Answer(id="anna", ok=True)]
)
def test_text_that_is_no_utf8_is_refused_like_all_that_is_malformed(message):
    """Older versions of msgspec raise an exception of another kind."""
    packed = codec.Codec().pack(message).replace(b"anna", b"an\xffa")
    read = (
        codec.Codec().answer if isinstance(message, m.Answer) else codec.Codec().request
    )
    with pytest.raises(ProtocolError) as caught:
        read(packed)
    assert "utf-8" in str(caught.value).lower()
    assert codec.refusal(caught.value, packed).id in {"i", ""}


def test_who_has_keys_that_ran_out_is_told_so(tmp_path, monkeypatch, run_dir):  # noqa: ARG001 - an empty folder
    """An agent drops them without a word."""
    pki.make_authority(tmp_path / "lab")
    keys = pki.issue(tmp_path / "lab", Role.MASTER, "anna", days=-0.01)
    monkeypatch.setenv(credentials.VARIABLE, str(keys))
    text = str(unreachable_reason.unreachable("arm0", "d", []))
    assert f"your keys: {keys}/cert.pem: the certificate has expired" in text
    assert "pbonet agent" not in text
    assert "start it with" in str(unreachable_reason.unreachable("arm0", "d", ["arm1"]))
