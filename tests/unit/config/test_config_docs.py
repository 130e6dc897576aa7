"""The examples and orders in docs/files.md are those that the readers accept."""

import re
from pathlib import Path

import pytest
from msgspec.structs import fields

from pbonet import config
from pbonet.config import job, rmod, sbs, seq, svar
from pbonet.config.library import Library
from pbonet.config.model import AgentConfig
from pbonet.config.types import TYPES

PAGE = (Path(__file__).parents[3] / "docs" / "files.md").read_text()
EXAMPLES = [
    block
    for block in re.findall(r"^```text\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    if block.endswith("EOF\n")
]


def parse_combination(text: str, file: str) -> object:
    library = Library()

    def part(name: str) -> config.Section:
        path = library.find_rmod(name)
        return config.Section(path.read_text(), str(path))

    rmod = config.parse_rmod(config.bundled(text, part), file)
    return library.load_rmod(rmod)


PARSE = {
    "COMBINE": parse_combination,
    "JOB": config.parse_job,
    "MODULE": config.parse_rmod,
    "SEQUENCE": config.parse_seq,
    "SUBSYSTEM": config.parse_sbs,
    "DEFINE": config.parse_svar,
}


@pytest.mark.parametrize("text", EXAMPLES, ids=lambda text: text.split()[0])
def test_every_example_is_accepted(text: str) -> None:
    PARSE[text.split(maxsplit=1)[0]](text, "example")


def test_there_is_an_example_of_each_format() -> None:
    assert {text.split()[0] for text in EXAMPLES} == set(PARSE)


def test_the_orders_are_the_readers_own() -> None:
    flat = " ".join(PAGE.split())
    grammars = (svar.GRAMMAR, rmod.GRAMMAR, sbs.HEAD, sbs.RTPU, job.GRAMMAR)
    for grammar in (*grammars, seq.GRAMMAR):
        assert grammar.text in flat


def test_every_type_and_every_key_of_agent_toml_is_named() -> None:
    for name in (*TYPES, *(field.name for field in fields(AgentConfig))):
        assert f"`{name}`" in PAGE
