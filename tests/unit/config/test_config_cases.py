"""Every case file beside what must come of it: the whole message, or the meaning.

A file `invalid-*.svar` stands beside `invalid-*.svar.txt`, a file `valid-*.svar` beside
`valid-*.svar.json`; `local-*.rmod` is refused only by its module.
A file that is no text is kept as hexadecimal digits in `*.hex`.
"""

import json
from pathlib import Path

import pytest

from pbonet import config
from pbonet.config.library import Library
from pbonet.config.write import meaning
from pbonet.errors import ConfigError, ParameterError
from pbonet.pbo import decode_params

CASES = Path(__file__).parent / "cases"
PARSE = {
    ".svar": config.parse_svar,
    ".rmod": config.parse_rmod,
    ".sbs": config.parse_sbs,
    ".job": config.parse_job,
    ".seq": config.parse_seq,
    ".toml": config.parse_agent,
}


def cases(kind: str) -> list[str]:
    return sorted(
        path.name
        for path in CASES.glob(f"{kind}-*")
        if path.suffix not in {".txt", ".json"}
    )


def content(name: str) -> tuple[bytes, str]:
    data = (CASES / name).read_bytes()
    if name.endswith(".hex"):
        return bytes.fromhex(data.decode()), name.removesuffix(".hex")
    return data, name


def test_every_expectation_has_its_case() -> None:
    expectations = {path.stem for path in CASES.iterdir() if path.suffix == ".txt"}
    assert expectations == {*cases("invalid"), *cases("local")}
    expectations = {path.stem for path in CASES.iterdir() if path.suffix == ".json"}
    assert expectations == set(cases("valid"))


@pytest.mark.parametrize("name", cases("invalid"))
def test_a_faulty_file_is_refused_with_its_own_message(name: str) -> None:
    data, file = content(name)
    with pytest.raises(ConfigError) as caught:
        PARSE[Path(file).suffix](data, file)
    assert str(caught.value) == (CASES / f"{name}.txt").read_text().rstrip("\n")
    assert caught.value.where.startswith(f"{file}:")
    assert caught.value.remedy


@pytest.mark.parametrize("name", cases("local"))
def test_local_values_that_the_module_does_not_take(name: str) -> None:
    """The file is in order; what LOCAL says is refused when the module is known."""
    record = config.parse_rmod((CASES / name).read_text(), name)
    cls = Library().load(record.module).cls
    with pytest.raises(ParameterError) as caught:
        decode_params(cls, record.local, where=record.file)
    assert str(caught.value) == (CASES / f"{name}.txt").read_text().rstrip("\n")
    assert caught.value.remedy


@pytest.mark.parametrize("name", cases("valid"))
def test_a_good_file_means_what_is_written_beside_it(name: str) -> None:
    data, file = content(name)
    record = PARSE[Path(file).suffix](data, file)
    expected = json.loads((CASES / f"{name}.json").read_text())
    assert says(json.loads(json.dumps(meaning(record))), expected)


def says(got: object, expected: object) -> bool:
    """Return whether `got` says what is expected; new fields do not matter."""
    if isinstance(got, list) and isinstance(expected, list):
        return len(got) == len(expected) and all(map(says, got, expected))
    if not isinstance(got, dict) or not isinstance(expected, dict):
        return got == expected
    for exact in ("aliases", "defines", "local"):
        if got.get(exact) != expected.get(exact):
            return False
    return all(key in got and says(got[key], expected[key]) for key in expected)
