"""What the protocol page says of resources."""

import re
from pathlib import Path
from typing import get_args

import msgspec
import pytest

from pbonet.xm.net import file_messages as f, messages as m, resource_messages as r

PAGE = (Path(__file__).parents[3] / "docs" / "protocol.md").read_text()
ROWS = dict(re.findall(r"^\| `(xm_\w+)` \|([^\n]*)", PAGE, re.MULTILINE))
COMMON = {field.name for field in msgspec.structs.fields(m.Request)}


@pytest.mark.parametrize("kind", get_args(r.AnyXmRequest | f.AnyFileRequest))
def test_every_operation_and_argument_is_on_the_page(kind):
    row = ROWS[kind.__struct_config__.tag]
    words = set(re.findall(r"`(\w+)`", row.split("|")[0]))
    assert {field.name for field in msgspec.structs.fields(kind)} - COMMON <= words


@pytest.mark.parametrize(
    ("operation", "record"),
    [
        ("xm_take", r.Took),
        ("xm_look", r.Seen),
        ("xm_overview", r.Resource),
        ("xm_stat", f.FileSeen),
    ],
)
def test_every_result_is_on_the_page(operation, record):
    words = set(re.findall(r"`(\w+)`", ROWS[operation].split("|")[1]))
    assert {field.name for field in msgspec.structs.fields(record)} <= words
