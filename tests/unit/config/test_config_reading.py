"""What the case files cannot show: long lines, missing files, writers, `read_any`."""

import os
from pathlib import Path

import msgspec
import numpy as np
import pytest

from pbonet import config
from pbonet.config.model import Limit, Rmod, SvarFile, Variable
from pbonet.config.reader import MAX_FILE, MAX_LINE, load
from pbonet.config.types import TYPES, numpy_type
from pbonet.errors import ConfigError, ConfigFileError

CASES = Path(__file__).parent / "cases"
LONG = 10_000_000
HEAD = "NAME Q\nTYPE double\nDESC d\nUNITS rad\nNELEM 1\n"


@pytest.mark.parametrize(
    ("parse", "file"),
    [
        (config.parse_svar, "a.svar"),
        (config.parse_rmod, "a.rmod"),
        (config.parse_sbs, "a.sbs"),
        (config.parse_job, "a.job"),
        (config.parse_agent, "a.toml"),
    ],
)
@pytest.mark.parametrize("filler", ["x", "0 ", "# "])
def test_a_line_of_ten_megabytes_is_refused_without_repeating_it(
    parse, file, filler
) -> None:
    text = "# first\n" + filler * (LONG // len(filler)) + "\nEOF\n"
    with pytest.raises(ConfigError) as caught:
        parse(text, file)
    assert str(caught.value) == (
        f"{file}:2:1: the line is too long (expected at most {MAX_LINE} characters, "
        f"got {LONG}); is this a configuration file at all?"
    )


def test_a_long_word_is_shortened_in_the_message() -> None:
    word = "Q" * (MAX_LINE - 100)
    with pytest.raises(ConfigError) as caught:
        config.parse_svar(f"NAME {word}\n" + HEAD[7:] + "EOF\n", "a.svar")
    assert str(caught.value) == (
        f"a.svar:1:6: the name '{'Q' * 37}...' is too long (expected at most 15 "
        f"characters, got {len(word)}); shorten it everywhere it is used"
    )


def test_unprintable_characters_are_escaped_in_the_message() -> None:
    with pytest.raises(ConfigError, match=r"'Q\\u202eX' cannot be the name"):
        config.parse_svar(HEAD.replace("Q", "Q\u202eX", 1) + "EOF\n")


def test_a_file_that_is_too_long() -> None:
    with pytest.raises(ConfigFileError) as caught:
        config.parse_svar(b"#\n" * (MAX_FILE // 2 + 1), "a.svar")
    assert str(caught.value) == (
        f"a.svar: the file is too long (expected at most {MAX_FILE} bytes); "
        "this is probably not a configuration file; name another"
    )


def test_a_missing_file_names_the_nearest_one(tmp_path: Path) -> None:
    (tmp_path / "arm.sbs").touch()
    with pytest.raises(ConfigFileError) as caught:
        config.read_sbs(tmp_path / "amr.sbs")
    assert str(caught.value) == (
        f"{tmp_path}/amr.sbs: the file cannot be read: No such file or directory; "
        f"did you mean {tmp_path}/arm.sbs?"
    )


def test_a_missing_file_is_not_one_of_another_kind(tmp_path: Path) -> None:
    (tmp_path / "arm.sbs").touch()
    with pytest.raises(ConfigFileError) as caught:
        config.read_svar(tmp_path / "arm.svar")
    assert caught.value.remedy == "check the path and its permissions"


def test_a_missing_folder() -> None:
    with pytest.raises(ConfigFileError) as caught:
        config.read_job("no/such/folder/a.job")
    assert str(caught.value) == (
        "no/such/folder/a.job: the file cannot be read: No such file or directory; "
        "check the path and its permissions"
    )


def test_what_is_no_regular_file_is_not_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.svar")
    for path in (tmp_path, tmp_path / "pipe.svar", Path("/dev/zero")):
        with pytest.raises(ConfigFileError) as caught:
            load(path)
        assert str(caught.value) == (
            f"{path}: this is not a regular file; name a configuration file"
        )


def test_a_path_that_no_file_can_have() -> None:
    with pytest.raises(ConfigFileError, match="the file cannot be read"):
        load("a\0b.svar")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_an_unreadable_file(tmp_path: Path) -> None:
    path = tmp_path / "arm.sbs"
    path.touch(mode=0)
    with pytest.raises(ConfigFileError) as caught:
        config.read_sbs(path)
    assert caught.value.what == "the file cannot be read: Permission denied"


def test_read_any_tells_the_format_by_the_ending() -> None:
    assert config.read_any(CASES / "valid-full.sbs") == config.read_sbs(
        CASES / "valid-full.sbs"
    )
    with pytest.raises(ConfigFileError) as caught:
        config.read_any("arm.cfg")
    assert str(caught.value) == (
        "arm.cfg: the file name has no known ending (expected .svar or "
        ".rmod or .sbs or .job or .seq or .toml, got .cfg); "
        "rename the file or name another"
    )


def test_a_name_without_its_ending_is_completed(tmp_path: Path) -> None:
    for name in ("arm.job", "arm.sbs", "arm.txt", "leg.job"):
        (tmp_path / name).touch()
    said = f"did you mean {tmp_path}/arm.sbs or {tmp_path}/arm.job?"
    for read in (config.read_any, config.read_sbs):
        with pytest.raises(ConfigFileError) as caught:
            read(tmp_path / "arm")
        assert caught.value.remedy == said
    with pytest.raises(ConfigFileError) as caught:
        config.read_any(tmp_path / "foot")
    assert caught.value.remedy == "rename the file or name another"


def test_places_are_kept_for_later_faults() -> None:
    rmod = config.parse_rmod((CASES / "valid-invdyn.rmod").read_text(), "invdyn.rmod")
    assert str(rmod.places["OUTVAR"]) == "invdyn.rmod:6:1"
    assert str(rmod.places["LOCAL"]) == "invdyn.rmod:10:1"
    assert str(rmod.local["FCLIMIT"].place) == "invdyn.rmod:12:1"
    table = config.parse_svar("\n  " + HEAD + "EOF\n", "a.svar")
    assert str(table.variables[0].place) == "a.svar:2:3"


def test_the_types_have_the_sizes_of_the_thesis() -> None:
    sizes = {
        "byte": 1, "char": 1, "word": 2, "short": 2, "unsigned": 4, "int": 4,
        "float": 4, "double": 8,
    }  # fmt: skip
    for name, size in sizes.items():
        assert np.dtype(numpy_type(name)).itemsize == size
    assert np.dtype(numpy_type("struct[48]")).itemsize == 48
    for name, kind in TYPES.items():
        dtype = np.dtype(numpy_type(name))
        assert dtype.itemsize == kind.size
        if dtype.kind in "iu":
            limits = np.iinfo(dtype)
            assert (limits.min, limits.max) == (kind.low, kind.high)
        elif dtype.kind == "f":
            assert float(np.finfo(dtype).max) == kind.high
    with pytest.raises(ValueError, match="'long' is not a type of a state variable"):
        numpy_type("long")


def test_a_record_that_no_file_can_say_is_not_written() -> None:
    variable = Variable(name="Q", type="double", desc="two\nlines")
    record = SvarFile(file="a.svar", defines={}, variables=(variable,))
    with pytest.raises(ConfigError) as caught:
        config.write_svar(record)
    assert str(caught.value) == (
        "a.svar: the record cannot be written as a file (expected a record as the "
        "reader returns it, got a.svar:4:1: unknown keyword 'lines' (expected UNITS); "
        "correct the keyword or remove the line); correct the record"
    )
    variable = msgspec.structs.replace(variable, desc=" indented")
    record = SvarFile(file="a.svar", defines={}, variables=(variable,))
    with pytest.raises(ConfigError) as caught:
        config.write_svar(record)
    assert str(caught.value) == (
        "a.svar: the record would mean something else after writing and reading "
        "(expected a record as the reader returns it); check texts for line ends, "
        "spaces at their ends and #"
    )


def test_written_files_are_pleasant_to_read() -> None:
    variable = Variable(
        name="Q",
        type="double",
        desc="position",
        units="rad",
        nelem=2,
        init=(0.5,),
        min=(-1.0, -2.0),
        max=(1.0, 2.0),
        maxage=0.02,
        limit=Limit.CLIP,
        finite=False,
    )
    record = SvarFile(file="a.svar", defines={"PI": "3.14"}, variables=(variable,))
    assert config.write_svar(record) == (
        "DEFINE PI 3.14\n\n"
        "NAME      Q\nTYPE      double\nDESC      position\nUNITS     rad\n"
        "NELEM     2\nINIT      0.5\nMIN       -1.0 -2.0\nMAX       1.0 2.0\n"
        "MAXAGE    0.02\nLIMIT     clip\nFINITE    no\n\nEOF\n"
    )
    rmod = Rmod(
        name="qdiff",
        file="qdiff.rmod",
        module="diff",
        desc="differentiator",
        aliases={"Z": "Q"},
        invar=("Z",),
        outvar=("Z^",),
        freq=100.0,
        critical=True,
    )
    assert config.write_rmod(rmod) == (
        "MODULE    diff\nDESC      differentiator\nSVARALIAS Z=Q\nINCONST   none\n"
        "OUTCONST  none\nINVAR     Z\nOUTVAR    Z^\nTASKTYPE  periodic\n"
        "FREQ      100.0\nCRITICAL  yes\nEOF\n"
    )
