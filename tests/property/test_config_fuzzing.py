"""Whatever stands in a file, the only exception is the reader's own error."""

from pathlib import Path

import pytest
from hypothesis import given, strategies as st

from pbonet import config
from pbonet.config import agent, job, rmod, sbs, seq, svar
from pbonet.config.write import meaning
from pbonet.errors import ConfigError

CASES = Path(__file__).parents[1] / "unit" / "config" / "cases"
PARSE = {
    ".svar": config.parse_svar,
    ".rmod": config.parse_rmod,
    ".sbs": config.parse_sbs,
    ".job": config.parse_job,
    ".seq": config.parse_seq,
    ".toml": config.parse_agent,
}
WRITE = {
    ".svar": config.write_svar,
    ".rmod": config.write_rmod,
    ".sbs": config.write_sbs,
    ".job": config.write_job,
    ".seq": config.write_seq,
}
KEYWORDS = [
    *svar.GRAMMAR.keywords,
    *rmod.GRAMMAR.keywords,
    *sbs.HEAD.keywords,
    *sbs.RTPU.keywords,
    *job.GRAMMAR.keywords,
    *seq.GRAMMAR.keywords,
    "LOCAL",
    "DEFINE",
    "EOF",
]
VALUES = [
    "double", "int", "bool", "struct[32]", "struct[A]", "A", "-A", "B", "0", "1", "2.5",
    "-1", "1e999", "0x7f", "nan", "inf", "yes", "no", "none", "clip", "periodic",
    "synchronous", "sporadic", "deferrable", "0.01", "MUF", "shared", "Z=Q", "Z", "Q",
    "#", "\u00e9", "x" * 99, "UNTIL", "FOR", "WITHIN", "ELSE", "IF", "OR", "(Q > 1)",
    "a:", "a", "forever",
]  # fmt: skip
endings = st.sampled_from(sorted(PARSE))
lines = st.builds(
    lambda keyword, values, gap: gap.join([keyword, *values]),
    st.sampled_from(KEYWORDS) | st.text(max_size=8),
    st.lists(st.sampled_from(VALUES) | st.text(max_size=8), max_size=4),
    st.sampled_from([" ", "\t", "  "]),
)
files = {
    ending: [
        path.read_bytes()
        for path in sorted(CASES.glob(f"*{ending}"))
        if path.name.startswith("valid")
    ]
    for ending in PARSE
}


def attempt(ending: str, data: str | bytes) -> None:
    """Read `data`; what can be read can also be written and means the same."""
    error = None
    try:
        record = PARSE[ending](data, f"fuzz{ending}")
    except ConfigError as caught:
        error = caught
    if error is not None:
        assert error.where.startswith("fuzz") or ending == ".rmod"  # it may be a part
        assert error.what
        assert error.remedy
        assert len(str(error)) < 2000
    elif ending in WRITE:
        text = WRITE[ending](record)
        assert meaning(PARSE[ending](text, f"fuzz{ending}")) == meaning(record)


@given(endings, st.text() | st.binary())
def test_anything(ending: str, data: str | bytes) -> None:
    attempt(ending, data)


@given(endings, st.lists(lines), st.sampled_from(["", "\nEOF", "\nEOF\n"]))
def test_lines_of_known_words(ending: str, text: list[str], end: str) -> None:
    attempt(ending, "\n".join(text) + end)


@given(st.data())
def test_mutations_of_good_files(data: st.DataObject) -> None:
    ending = data.draw(endings)
    content = bytearray(data.draw(st.sampled_from(files[ending])))
    for _ in range(data.draw(st.integers(1, 4))):
        start = data.draw(st.integers(0, len(content)))
        length = data.draw(st.integers(0, 12))
        insert = data.draw(st.binary(max_size=4) | lines.map(str.encode))
        content[start : start + length] = insert
    attempt(ending, bytes(content))


@given(st.data())
def test_exchanged_and_repeated_lines(data: st.DataObject) -> None:
    ending = data.draw(endings)
    source = data.draw(st.sampled_from(files[ending])).decode("utf-8-sig").split("\n")
    chosen = data.draw(st.lists(st.sampled_from(source), max_size=len(source) + 4))
    attempt(ending, "\n".join(chosen) + data.draw(st.sampled_from(["", "\nEOF"])))


@given(st.data())
def test_a_good_file_cut_short_is_noticed(data: st.DataObject) -> None:
    """Every proper beginning that loses more than white space is refused."""
    ending = data.draw(endings.filter(lambda found: found != ".toml"))
    content = data.draw(st.sampled_from(files[ending])).rstrip()
    cut = data.draw(st.integers(0, len(content) - 1))
    with pytest.raises(ConfigError):
        PARSE[ending](content[:cut], f"fuzz{ending}")


def test_deep_nesting_is_no_stack_overflow() -> None:
    with pytest.raises(ConfigError, match="this is not TOML: nested too deeply"):
        agent.parse_agent("name = " + "[" * 100_000, "fuzz.toml")
