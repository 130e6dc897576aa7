"""What docs/errors.md shows is run as it stands there."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from pbonet.cli import verbs
from pbonet.pbo import Handling

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs" / "errors.md").read_text()


@pytest.mark.slow
def test_the_example_passes_its_own_tests(tmp_path):
    for name, text in re.findall(
        r"<!-- file: (\S+) -->\n```\w*\n(.*?)```", PAGE, re.DOTALL
    ):
        (tmp_path / name).write_text(text)
    options = ("-q", "-p", "no:cacheprovider", "--rootdir", tmp_path)
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *options, tmp_path],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout
    assert "3 passed" in done.stdout


def test_the_options_of_events_are_there():
    names = {name for one in verbs.load("events").options for name in one.all_names}
    options = set(re.findall(r"pbonet events arm\.sbs (--\w+)", PAGE))
    assert options
    assert options <= names


def test_every_answer_of_a_handler_is_explained():
    for answer in Handling:
        assert f"`Handling.{answer.name}`" in PAGE
