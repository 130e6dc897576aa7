"""Ranges of versions, and what is told of those that have none in common."""

from pathlib import Path

import pytest

import pbonet
from pbonet import versions
from pbonet.versions import LAYERS, Range
from pbonet.xm.net import messages as m


@pytest.mark.parametrize(
    ("one", "other", "found"),
    [
        ((1, 1), (1, 1), 1),
        ((1, 3), (2, 5), 3),
        ((1, 3), (2, 2), 2),
        ((1, 1), (2, 3), None),
    ],
)
def test_the_highest_common_version(one, other, found):
    assert versions.common(Range(*one), Range(*other)) == found
    assert versions.common(Range(*other), Range(*one)) == found


@pytest.mark.parametrize(
    ("others", "found"),
    [
        ([], 3),
        ([Range(1, 3), Range(1, 2)], 2),
        ([Range(1, 3), None], 1),
        ([Range(7, 9), Range(2, 2)], 2),
    ],
)
def test_what_is_sent_to_several(others, found):
    assert versions.spoken(Range(1, 3), others) == found


def info(name, protocol=1, **layers):
    return m.AgentInfo(
        **dict.fromkeys(("domain", "machine", "backend", "version", "python"), ""),
        **dict.fromkeys(("core", "cores", "pid", "rtpu_pid"), 0),
        name=name,
        host=f"host-{name}",
        protocol=protocol,
        versions=layers,
    )


def test_what_an_agent_does_not_tell_is_its_first_version():
    old = info("old", protocol=4)
    assert old.understands("commands") == Range(4, 4)
    assert old.understands("table") == Range(1, 1)
    assert info("new", table=Range(2, 3)).understands("table") == Range(2, 3)


def test_each_pair_of_sides_without_a_common_version_is_told():
    agents = [
        info("a", table=Range(1, 2)),
        info("b", table=Range(3, 3)),
        info("c", table=Range(1, 2)),
        info("d", table=Range(2, 3)),
    ]
    assert m.mismatched(agents) == [
        "no common version of table: a of host-a, c of host-c versions 1 to 2; "
        "b of host-b version 3; no values are exchanged between them",
        "d of host-d sends tables in version 2, for all at once, which b of host-b "
        "cannot read; no values of it arrive there",
    ]
    assert m.mismatched([info("e", protocol=9)]) == [
        "no common version of commands: this program version 1; e of host-e version 9; "
        "between them only hello and stop work"
    ]


@pytest.mark.parametrize("last", [Range(1, 2), Range(2, 2)])
def test_where_all_can_read_what_each_sends_nothing_is_told(last):
    """Ranges of which each two overlap have a version that is in all of them."""
    tables = [Range(1, 2), Range(2, 3), last]
    agents = [info(name, table=one) for name, one in zip("abc", tables, strict=True)]
    assert m.mismatched(agents) == []


def test_links_have_the_version_of_their_header_file():
    header = Path(pbonet.__file__).parent / "tbuf" / "message.h"
    newest = LAYERS["links"].newest
    assert f"TB_MESSAGE_VERSION = {newest}" in header.read_text()
