"""The RMODs that remedies name: read when one is asked for, and again when changed."""

from __future__ import annotations

import os
from unittest.mock import patch

import pytest

from pbonet.config import Library
from pbonet.master.configuration import Files, subsystem_files


@pytest.fixture
def files(puma):
    return Files(puma, Library())


def test_files_are_not_read_again_while_none_has_changed(files):
    found = dict(files.producers())
    assert "jttrace" in found["Q_REF"]
    with patch.object(subsystem_files.config, "parse_rmod", side_effect=AssertionError):
        assert dict(files.producers()) == found


def test_a_file_that_was_added_changed_or_removed_is_seen(files, puma):
    before = dict(files.producers())
    text = files.rmod("jttrace").text
    new = puma.with_name("mine.rmod")
    new.write_text(text)
    assert "mine" in files.producers()["Q_REF"]
    new.write_text(text.replace("EOF", "# changed\nEOF", 1))
    os.utime(new, ns=(1, 1))
    with patch.object(subsystem_files.config, "parse_rmod") as parse:
        len(files.producers())
    assert parse.called
    new.unlink()
    assert dict(files.producers()) == before
