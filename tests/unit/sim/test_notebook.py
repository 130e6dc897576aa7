"""A subsystem and a log in a notebook: shown, as arrays, as tables, and as plots."""

from __future__ import annotations

import ast
import json
import shlex
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest

from pbonet.errors import LogError, UnknownVariableError
from pbonet.log import Series
from pbonet.master import Subsystem
from pbonet.master.subsystem.variable_arrays import array_of

EXAMPLES = Path(__file__).parents[3] / "examples"
PUMA = EXAMPLES / "puma" / "puma.job"


@pytest.fixture(autouse=True)
def drawn_nowhere():
    mpl.use("Agg")
    yield
    from matplotlib import pyplot

    pyplot.close("all")


@pytest.fixture(scope="module")
def arm():
    """The PUMA after a second of virtual time."""
    with Subsystem(PUMA, virtual=True) as subsystem:
        subsystem.start()
        subsystem.wait(1.0)
        yield subsystem


class Cells(HTMLParser):
    """The texts of a page's table, and every tag."""

    def __init__(self, page):
        super().__init__()
        self.tags, self.cells = [], []
        self._inside = False
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        del attrs
        self.tags.append(tag)
        if tag in {"td", "th"}:
            self.cells.append("")
            self._inside = True

    def handle_endtag(self, tag):
        self._inside = self._inside and tag not in {"td", "th"}

    def handle_data(self, data):
        if self._inside:
            self.cells[-1] += data


def test_before_it_is_open_it_shows_what_is_planned():
    page = Subsystem(PUMA, virtual=True)._repr_html_()
    cells = Cells(page).cells
    assert cells[:5] == ["task", "RTPU", "Hz", "module", ""]
    assert cells[5:9] == ["puma_pidg", "arm0", "500", "puma_pidg"]
    assert "not open" in page
    assert page.count("<svg") == 1


def test_open_it_shows_states_and_rates(arm):
    page = Cells(arm._repr_html_())
    at = page.cells.index("puma_pidg")
    rtpu, state, hertz, of, cycles, missed = page.cells[at + 1 : at + 7]
    assert (rtpu, state, of, missed) == ("arm0", "● ON", "500", "0")
    assert float(hertz) == pytest.approx(500, rel=0.01)
    assert int(cycles) >= 499
    assert "svg" in page.tags


def test_what_a_task_says_is_text(tmp_path):
    evil = "<img src=x onerror=alert(1)>"
    (tmp_path / "bad.py").write_text(
        "from pbonet import PortBasedObject\n"
        "class Bad(PortBasedObject, freq=10):\n"
        f'    """{evil}"""\n'
        "    def cycle(self, dt):\n"
        f"        raise RuntimeError({evil!r})\n"
    )
    (tmp_path / "t.svar").write_text(
        f"NAME X\nTYPE double\nDESC {evil}\nUNITS none\nNELEM 1\nEOF\n"
    )
    (tmp_path / "t.sbs").write_text("SUBSYSTEM t\nSVARFILE t.svar\nRTPU a\nEOF\n")
    (tmp_path / "t.job").write_text("JOB t\nDESC d\nSBS t.sbs\nTASK bad\nEOF\n")
    subsystem = Subsystem(
        tmp_path / "t.job", libraries=[tmp_path], virtual=True, warned=lambda _: None
    )
    planned = subsystem._repr_html_()
    with subsystem:
        subsystem.start()
        subsystem.wait(0.5)
        failed = subsystem._repr_html_()
        subsystem.clear("bad")
    for page in (planned, failed):
        assert "img" not in Cells(page).tags
        assert "&lt;img src=x" in page
    assert "✖ ERROR" in Cells(failed).cells


def test_a_wrong_file_is_said_in_its_place(tmp_path):
    shutil.copytree(PUMA.parent, tmp_path / "puma")
    subsystem = Subsystem(tmp_path / "puma" / "puma.job", virtual=True)
    (tmp_path / "puma" / "puma.job").unlink()
    (tmp_path / "puma" / "qrdiff.rmod").write_text("MODULE <b>\n")
    page = subsystem._repr_html_()
    assert "qrdiff.rmod" in page
    assert "<b>\n" not in page


def test_values_are_arrays_of_the_tables_type(arm):
    assert arm.value("NDOF").dtype.kind == "i"
    assert arm.value("NDOF").shape == ()
    assert int(arm.value("NDOF")) == 6
    found = arm.values("Q*_MEZ")
    assert list(found) == ["Q_MEZ", "Q^_MEZ"]
    assert all(one.shape == (6,) and one.dtype == np.float64 for one in found.values())
    shown = arm.display("Q_MEZ")[0].values
    assert found["Q_MEZ"].tolist() == shown
    assert set(arm.values()) == {one.name for one in arm.files.table.variables}
    with pytest.raises(UnknownVariableError, match="Q_MEX"):
        arm.value("Q_MEX")


def test_structs_keep_their_bytes():
    from pbonet.config import Variable

    held = Variable(name="S", type="struct[4]", nelem=2)
    made = array_of(b"abcdefgh", held)
    assert made.shape == (2,)
    assert made[1].tobytes() == b"efgh"
    one = array_of([3.0], Variable(name="N", type="float32"))
    assert (one.shape, one.dtype) == ((), np.float32)


def test_a_series_is_a_pair_that_draws_itself(arm):
    series = arm.simulation.recording.series("Q_MEZ")
    seconds, values = series
    assert isinstance(series, Series)
    assert len(seconds) == len(values) >= 499
    axis = series.plot()
    assert axis.get_ylabel() == "Q_MEZ [rad]"
    assert [line.get_label() for line in axis.lines] == series.columns
    assert series.columns[5] == "Q_MEZ[5]"
    np.testing.assert_array_equal(axis.lines[2].get_ydata(), values[:, 2])
    assert series.plot(axis) is axis
    assert series.writers == [(seconds[0], "puma_pidg")]


def test_a_series_is_a_table_of_pandas(arm):
    series = arm.simulation.recording.series("Q_MEZ")
    table = series.to_pandas()
    assert list(table.columns) == series.columns
    assert table.index.name == "s"
    np.testing.assert_array_equal(table.index, series.seconds)
    np.testing.assert_array_equal(table["Q_MEZ[3]"], series.values[:, 3])
    assert table.attrs["unit"] == "rad"


@pytest.mark.parametrize(
    ("package", "extra"), [("pandas", "pandas"), ("matplotlib.pyplot", "plot")]
)
def test_without_the_package_it_says_what_to_install(arm, monkeypatch, package, extra):
    monkeypatch.setitem(sys.modules, package, None)
    series = arm.simulation.recording.series("Q_MEZ")
    with pytest.raises(LogError, match=rf"pip install \"pbonet\[{extra}\]\""):
        series.to_pandas() if extra == "pandas" else series.plot()


def run(cells, folder):
    """Run the cells of a notebook in a folder; return what each one shows.

    A line that begins with ! is a command of the shell, as in a notebook.
    """
    names, shown = {"__name__": "__main__"}, []
    for cell in cells:
        if cell.startswith("!"):
            words = shlex.split(cell[1:])
            program = Path(sys.executable).with_name(words[0])
            subprocess.run(
                [program, *words[1:]], check=True, cwd=folder, stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
            )  # fmt: skip
            continue
        *before, last = ast.parse(cell).body
        if isinstance(last, ast.Expr):
            name = ast.Name("_shown", ast.Store())
            last = ast.copy_location(ast.Assign([name], last.value), last)
        tree = ast.fix_missing_locations(ast.Module([*before, last], []))
        names.pop("_shown", None)
        exec(compile(tree, "<cell>", "exec"), names)  # noqa: S102 - the cell
        value = names.get("_shown")
        page = getattr(value, "_repr_html_", None)
        shown.append(page() if page else value)
    return shown


def test_the_example_runs(tmp_path, monkeypatch, capsys):
    for name in ("puma", "notebook"):
        shutil.copytree(EXAMPLES / name, tmp_path / name)
    monkeypatch.chdir(tmp_path / "notebook")
    page = json.loads(Path("puma.ipynb").read_text("utf-8"))
    code = [one for one in page["cells"] if one["cell_type"] == "code"]
    assert all(not one["outputs"] and one["execution_count"] is None for one in code)
    shown = run(["".join(one["source"]) for one in code], tmp_path / "notebook")
    assert "not open" in shown[0]
    assert "● ON" in shown[1]
    assert 0 < shown[2] < 1, "it follows"
    assert set(shown[3]) == {"Q_MEZ", "Q^_MEZ"}
    assert "parameter kp" in capsys.readouterr().out, "the refusal"
    assert shown[5].get_ylabel() == "Q_MEZ [rad]"
    assert "T_GRAV[5]" in shown[6], "a table of pandas"
    assert shown[-1].shape == (6,)


def test_the_page_runs(monkeypatch):
    monkeypatch.chdir(EXAMPLES.parent)
    page = (EXAMPLES.parent / "docs" / "notebook.md").read_text("utf-8")
    (block,) = page.split("```python\n")[1:]
    run([block.partition("```")[0]], EXAMPLES.parent)
