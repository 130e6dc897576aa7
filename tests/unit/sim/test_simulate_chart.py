"""Charts of schedules: every character of a small one, the SVG's shapes."""

from xml.etree import ElementTree

import pytest

from pbonet.analysis.schedule import chart
from pbonet.analysis.schedule.simulate import PeriodicTask, simulate

MS = 1_000_000


@pytest.fixture
def outcome():
    soft = PeriodicTask(
        name="soft", period_ns=10 * MS, cost=7 * MS, effective_ns=4 * MS
    )
    hard = PeriodicTask(name="h", period_ns=10 * MS, cost=int(4.5 * MS))
    return simulate([soft, hard], until_ns=20 * MS)


def test_a_chart_of_text(outcome) -> None:
    assert chart.as_text(outcome, unit_ns=MS, marks=chart.ASCII).splitlines() == [
        "soft ####....--#+........",
        "     '         x",
        "   h ....####+..+####....",
        "     '         '",
        "  ms 0         10",
        "a column is 1 ms; # runs, - runs in time that others leave, ' release, x "
        "deadline missed",
    ]


def test_a_stretch_of_a_chart(outcome) -> None:
    text = chart.as_text(outcome, begin_ns=8 * MS, end_ns=12 * MS, columns=8)
    assert text.splitlines()[:5] == [
        "soft ·░░░███·",
        "         ✗",
        "   h █······█",
        "         ╵",
        "  ms 8",
    ]
    assert "a column is 0.5 ms" in text


def test_a_chart_has_no_more_columns_than_asked_for(outcome) -> None:
    for columns in (1, 7, 20, 100):
        lines = chart.as_text(outcome, columns=columns).splitlines()
        assert len(lines[0]) <= 5 + columns


def test_the_unit_that_fits() -> None:
    assert chart.nice_unit(72, 72) == 1
    assert chart.nice_unit(73, 72) == 2
    assert chart.nice_unit(500, 72) == 10
    assert chart.nice_unit(720 * MS, 72) == 10 * MS
    assert chart.nice_unit(721 * MS, 72) == 20 * MS


def test_a_picture(outcome) -> None:
    text = chart.as_svg(outcome, title="T < 10 & soft")
    root = ElementTree.fromstring(text)  # noqa: S314 - our own
    ns = "{http://www.w3.org/2000/svg}"
    bars = [r for r in root.iter(f"{ns}rect") if "fill-opacity" in r.attrib]
    assert len(bars) == len(outcome.segments)
    pale = [bar for bar in bars if bar.get("fill-opacity") == "0.35"]
    assert len(pale) == sum(segment.crit == 3 for segment in outcome.segments) > 0
    wide = {segment.task: 0.0 for segment in outcome.segments}
    for bar, segment in zip(bars, outcome.segments, strict=True):
        wide[segment.task] += float(bar.get("width", "0"))
    scale = (760 - 72 - 16) / (20 * MS)
    for name, width in wide.items():
        assert width == pytest.approx(outcome.tasks[name].cpu_ns * scale, abs=0.05)
    assert len(list(root.iter(f"{ns}path"))) == 1
    labels = [element.text for element in root.iter(f"{ns}text")]
    assert labels[:3] == ["T < 10 & soft", "soft", "h"]


def test_an_empty_stretch_is_refused(outcome) -> None:
    for draw in (chart.as_text, chart.as_svg):
        with pytest.raises(ValueError, match="nothing to show from 5 ns to 5 ns"):
            draw(outcome, begin_ns=5, end_ns=5)
