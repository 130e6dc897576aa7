"""Values of variables as an agent sends them."""

from __future__ import annotations

import math

import msgspec
import pytest

from pbonet.config.model import Variable
from pbonet.node.agent import variable_values
from pbonet.svar import Table

VARIABLES = (
    Variable(name="F", type="float", nelem=3, finite=False),
    Variable(name="D", type="double", nelem=2),
    Variable(name="U", type="uint64"),
    Variable(name="I", type="char", nelem=2),
    Variable(name="B", type="bool", nelem=3),
    Variable(name="S", type="struct[3]", nelem=2),
)
VALUES = {
    "F": [0.1, math.inf, 0.0],
    "D": [0.1, -0.0],
    "U": [2**64 - 1],
    "I": [-128, 127],
    "B": b"\x02\x00\x01",
    "S": b"abcdef",
}
SENT = {
    "F": "[0.10000000149011612,null,0.0]",
    "D": "[0.1,-0.0]",
    "U": "[18446744073709551615]",
    "I": "[-128,127]",
    "B": "[1,0,1]",
    "S": '"YWJjZGVm"',
}


@pytest.fixture
def table(tmp_path, monkeypatch):
    monkeypatch.setenv("PBONET_SHM_DIR", str(tmp_path))
    with Table.create("arm", VARIABLES) as made:
        for name, values in VALUES.items():
            made.write(name, values)
        yield made


def test_values_of_each_type_are_sent_as_they_are(table):
    """One read is of a single variable, the other a copy of all at one instant."""
    together = variable_values.display(table, None)
    alone = [variable_values.display(table, [name])[0] for name in VALUES]
    for found in (together, alone):
        sent = {one.name: msgspec.json.encode(one.values).decode() for one in found}
        assert sent == SENT
        assert all(one.whole for one in found)
