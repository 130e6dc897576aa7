"""Releases: what they are called, and what is no release."""

import os

import pytest

from pbonet.deploy import releases_of
from pbonet.deploy.release import release_of
from pbonet.errors import ConfigError, ConfigFileError


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


def test_the_wheels_of_what_it_needs_are_part_of_its_name(make_wheel, tmp_path):
    wheel, house = make_wheel(), tmp_path / "house"
    house.mkdir()
    any_, arm = (
        "py3-none-any",
        "cp311-cp311-manylinux2014_aarch64.manylinux_2_17_aarch64",
    )
    for tag in (any_, arm):
        make_wheel(tag=tag).rename(house / f"numpy-2.0.0-{tag}.whl")
    first = release_of(wheel, (), house)
    assert [one.name for one in first.wheelhouse] == [f"numpy-2.0.0-{any_}.whl"]
    assert first.name != release_of(wheel).name
    make_wheel(tag=any_, record="b").rename(house / f"numpy-2.0.0-{any_}.whl")
    assert release_of(wheel, (), house).name != first.name
    away = release_of(make_wheel(tag="cp311-cp311-linux_aarch64"), (), house)
    assert len(away.wheelhouse) == 2


@pytest.mark.parametrize(
    ("other", "said"),
    [
        ({"version": "0.3.0"}, "of several versions"),
        ({"tag": "cp311-cp311-linux_x86_64"}, "two wheels are for one kind of machine"),
    ],
)
def test_wheels_are_of_one_version_for_different_machines(make_wheel, other, said):
    with pytest.raises(ConfigError, match=said):
        releases_of([make_wheel(), make_wheel(**other)])
