"""Releases: what they are called, and what is no release."""

import os

import pytest

from pbonet.deploy import release_of
from pbonet.errors import ConfigFileError


def test_a_release_is_named_by_what_is_in_it(make_wheel):
    wheel = make_wheel()
    first = release_of(wheel)
    assert first.name.startswith("0.2.0-")
    assert (first.python, first.machine) == ("3.11", "x86_64")
    os.utime(wheel, (0, 0))
    assert release_of(make_wheel()).name == first.name
    assert release_of(make_wheel(record="b")).name != first.name
    assert release_of(wheel, ["robot"]).name != release_of(wheel).name
    assert release_of(wheel, ["robot", "files"]).requirement.endswith(
        ".whl[files,robot]"
    )


def test_what_is_no_release_is_refused(make_wheel, tmp_path):
    with pytest.raises(ConfigFileError, match="not a wheel of pbonet"):
        release_of(tmp_path / "numpy-2.0-cp311-cp311-linux_x86_64.whl")
    with pytest.raises(ConfigFileError, match=r"cannot be read.*--build"):
        release_of(tmp_path / "pbonet-0.9.0-cp311-cp311-linux_x86_64.whl")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigFileError, match=r"has no wheels.*pip download"):
        release_of(make_wheel(), (), tmp_path / "empty")
