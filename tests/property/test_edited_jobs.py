"""Whatever is edited can be undone to the byte, and is saved as it is shown."""

import tempfile
from pathlib import Path

import pytest
from edited_jobs import content, puma_files
from hypothesis import given, settings, strategies as st

from pbonet.errors import PbonetError, PbonetError as Refused
from pbonet.master.configuration import check_file
from pbonet.master.editing import JobEditor

MODULES = ["jttrace", "qrdiff", "grav_comp", "join_min", "gain", "qrint", "constant"]
NAMES = ["NDOF", "DH", "Q_REF", "Q^_REF", "Q_MEZ", "T_GRAV", "Z", "Y", "NEW", "Q_REF'"]
FIELDS = [
    ("rtpu", ["arm0", "arm1", "arm9", None]),
    ("freq", [50, 2000.0, None]),
    ("maxc", [0.001, 0.5, -1, "x", None]),
    ("critical", [True, False]),
    ("crit", [1, 200, None]),
    ("desc", ["new words", "two\nlines", ""]),
    ("tasktype", ["periodic", "synchronous", "often"]),
    ("restart", ["on", "never", "off"]),
    ("stale", ["hold", None]),
    ("safe_at", ["deadline", "maxexec deadline", "late", ""]),
]
PARAMS = [
    ("TAU", "0.2"),
    ("REPEAT", "no"),
    ("GAIN", "2"),
    ("KP", "1 # 2"),
    ("KP", None),
]


@st.composite
def _edit(draw):
    """Return a change; tasks and offers are numbers, because names come and go."""
    kind = draw(
        st.sampled_from([
            "add", "add", "remove", "rename", "field", "field", "param", "connect",
            "connect", "disconnect", "variable", "variable field", "fallback",
            "off", "apply", "apply", "undo", "redo", "save", "job",
        ])
    )  # fmt: skip
    number = draw(st.integers(0, 11))
    if kind == "field":
        field, values = draw(st.sampled_from(FIELDS))
        return kind, number, (field, draw(st.sampled_from(values)))
    words = {
        "add": MODULES,
        "param": PARAMS,
        "connect": NAMES,
        "variable": NAMES,
        "fallback": [*MODULES, None],
        "rename": ["one", "two", "jttrace", "no name"],
    }
    return kind, number, draw(st.sampled_from(words.get(kind, [None])))


def _one_of(values, number):
    return values[number % len(values)] if values else None


def _do(editor, kind, number, what):  # noqa: C901, PLR0912 - one line for each change
    task = _one_of([*editor.state()["settings"]], number)
    match kind:
        case "add":
            editor.add_task(what)
        case "remove":
            editor.remove_task(task)
        case "rename":
            editor.rename_task(task, what)
        case "field":
            editor.set_field(task, *what)
        case "param":
            editor.set_parameter(task, *what)
        case "connect" | "disconnect":
            ports = [
                port["port"]
                for one in editor.state()["graph"]["tasks"]
                if one["name"] == task
                for port in (*one["ins"], *one["outs"])
            ]
            port = _one_of(ports, number // 2)
            if kind == "connect":
                editor.connect(task, port, what)
            else:
                editor.disconnect(task, port)
        case "variable":
            editor.add_variable(what, nelem=number + 1, units="rad", desc="new")
        case "variable field":
            name = _one_of(
                [v["name"] for v in editor.state()["graph"]["variables"]], number
            )
            editor.set_variable(name, "maxage", number / 4)
        case "fallback":
            editor.set_fallback(task, what)
        case "off":
            editor.set_off_order([task])
        case "job":
            editor.set_job(desc=f"number {number}", post=["NDOF == 6"] * (number % 2))
        case "apply":
            if offer := _one_of(editor.offers(), number):
                editor.apply(offer)
        case _:
            getattr(editor, kind)()


def _shown(state):
    """Return what of a state must be the same after saving and opening again."""
    return {k: v for k, v in state.items() if k not in {"undo", "redo", "unsaved"}}


@pytest.mark.slow
@settings(max_examples=20, deadline=None)
@given(st.lists(_edit(), max_size=7))
def test_edits_are_undone_to_the_byte_and_saved_as_shown(edits):
    with tempfile.TemporaryDirectory() as name:
        job = puma_files(Path(name))
        first = content(job.parent)
        editor = JobEditor(job)
        for edit in edits:
            before = editor.state()
            try:
                _do(editor, *edit)
            except PbonetError:
                assert editor.state() == before
        state = editor.state()
        if state["settings"]:
            editor.save()
            assert editor.changes() == []
            assert _shown(JobEditor(job).state()) == _shown(state)
            found = check_file(job)
            assert [str(Refused.from_wire(one)) for one in found.errors] == state[
                "errors"
            ]
            assert found.warnings == state["warnings"]
        while editor.state()["undo"]:
            editor.undo()
        editor.save()
        assert content(job.parent) == first
