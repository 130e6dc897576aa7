"""Every error that a user can meet says what to do."""

import ast
from pathlib import Path

from pbonet import errors

PACKAGE = Path(__file__).parents[3] / "pbonet"
PARTS = ("deploy", "master", "node", "svar", "xm")
KINDS = {
    name
    for name, kind in vars(errors).items()
    if isinstance(kind, type) and issubclass(kind, errors.PbonetError)
}
WITHOUT = {
    "cannot be allocated": "its parts say what to do",
    "cannot be assembled": "its parts say what to do",
    "cannot be simulated": "its parts say what to do",
    "error.error.what": "in the module's own words",
    "executor.task.errmsg": "in the module's own words",
}


def without_remedy(path):
    """Return the first argument of every error that is made without a remedy."""
    text = path.read_text()
    for call in ast.walk(ast.parse(text)):
        if not isinstance(call, ast.Call) or not isinstance(call.func, ast.Name):
            continue
        given = {keyword.arg for keyword in call.keywords}
        if call.func.id in KINDS and not given & {"remedy", None}:
            what = ast.get_source_segment(text, call.args[0]) if call.args else ""
            yield f"{path.name}:{call.lineno}: {what}"


def test_every_error_that_a_user_can_meet_says_what_to_do():
    found = [
        line
        for part in PARTS
        for path in sorted((PACKAGE / part).rglob("*.py"))
        for line in without_remedy(path)
    ]
    assert [line for line in found if not any(one in line for one in WITHOUT)] == []
    assert len(found) == len(WITHOUT), "the list of exceptions is true"


def test_an_error_without_one_is_seen(tmp_path):
    path = tmp_path / "bad.py"
    path.write_text("raise StateError('it is wrong', got='this')\n")
    assert list(without_remedy(path)) == ["bad.py:1: 'it is wrong'"]
