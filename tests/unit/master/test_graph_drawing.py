"""Drawings of a graph: no wire crosses a card, and no text is anything but text."""

from __future__ import annotations

import random
import re
from itertools import combinations, pairwise
from pathlib import Path
from xml.dom import minidom

import pytest
from msgspec import structs

from pbonet import cli
from pbonet.config import Library
from pbonet.master.configuration import (
    Files,
    Graph,
    GraphFault,
    GraphPort,
    GraphRtpu,
    GraphTask,
    GraphVariable,
    Link,
    Wire,
    graph_svg,
    graph_text,
    job_graph,
)
from pbonet.master.configuration.graph_layout import layout

EXAMPLES = Path(__file__).parents[3] / "examples"
JOBS = sorted(EXAMPLES.glob("*/*.job"))
EVIL = '<script>"&]]>\n#lt; `x` |a| {b} \x07</script>'


def graph_of_job(job: Path) -> Graph:
    return job_graph(Files(job, Library([job.parent]), code=False), code=False)


def port(name, *, constant=False):
    return GraphPort(
        port=name, variable=name, constant=constant, unit="m", shape=[3], type="double"
    )


def made(tasks, faults=(), links=(), desc="", devices=()):
    """Return a graph; `tasks` are names with what each reads and writes, and RTPU."""
    found = [
        GraphTask(
            name=name, module="m", class_="controller", desc=desc, rtpu=rtpu,
            freq=10.0, type="periodic", crit="", critical=False, fallback_of="",
            parts=[], devices=[*devices], ins=[*map(port, ins)],
            outs=[*map(port, outs)], params=[], rmod_file="",
        )
        for name, ins, outs, rtpu in tasks
    ]  # fmt: skip
    names = sorted({v for _, ins, outs, _ in tasks for v in (*ins, *outs)})
    writers = {v: [n for n, _, outs, _ in tasks if v in outs] for v in names}
    readers = {v: [n for n, ins, _, _ in tasks if v in ins] for v in names}
    variables = [
        GraphVariable(
            name=v, desc=desc, unit="m", type="double", shape=[3], n=3, constant=False,
            writers=writers[v], readers=readers[v],
        )
        for v in names
    ]  # fmt: skip
    wires = [
        Wire(v, a, b, False) for v in names for a in writers[v] for b in readers[v]
    ]
    rtpus = sorted({rtpu for _, _, _, rtpu in tasks})
    return Graph(
        name="made", job="", rtpus=[GraphRtpu(r, "MUF", False) for r in rtpus],
        tasks=found, variables=variables, wires=wires, links=[*links],
        faults=[*faults],
    )  # fmt: skip


def random_graph(seed):
    """Return tasks that are connected by chance, also in circles and to themselves."""
    chance = random.Random(seed)
    count = chance.randint(1, 12)
    names = [f"V{n}" for n in range(3 * count)]
    outs = {name: chance.randrange(count) for name in names}
    return made([
        (
            f"t{n}",
            chance.sample(names, chance.randint(0, 4)),
            [name for name in names if outs[name] == n],
            f"r{chance.randrange(3)}",
        )
        for n in range(count)
    ])


def pieces(points):
    """Return the pieces of a way, each as a box without width or without height."""
    for (x0, y0), (x1, y1) in pairwise(points):
        assert x0 == x1 or y0 == y1, "a wire runs level or upright"
        if (x0, y0) != (x1, y1):
            yield min(x0, x1), min(y0, y1), max(x0, x1), max(y0, y1)


def must_be_readable(graph):
    places = layout(graph)
    boxes = [(c.x, c.y, c.x + c.width, c.y + c.height) for c in places.cards]
    for (ax, ay, bx, by), (cx, cy, dx, dy) in combinations(boxes, 2):
        assert bx <= cx or dx <= ax or by <= cy or dy <= ay, "two cards overlap"
    for card in places.cards:
        band = places.bands[card.band]
        assert band.rtpu == card.task.rtpu
        assert band.y < card.y
        assert card.y + card.height < band.y + band.height
    for one, other in combinations(places.bands, 2):
        assert one.y + one.height <= other.y
    ways = [(route.net, [*pieces(route.points)]) for route in places.routes]
    for _, way in ways:
        for x0, y0, x1, y1 in way:
            assert x0 >= 0
            assert x1 <= places.width
            for ax, ay, bx, by in boxes:
                assert x1 <= ax or bx <= x0 or y1 <= ay or by <= y0, "through a card"
    assert len(places.routes) == len(graph.wires)
    ends = {(route.points[0], route.points[-1]) for route in places.routes}
    assert len(ends) == len(graph.wires), "each wire has its own two ends"
    return ways


@pytest.mark.parametrize("job", JOBS, ids=lambda job: f"{job.parent.name}-{job.stem}")
def test_the_examples_are_readable(job):
    graph = graph_of_job(job)
    ways = must_be_readable(graph)
    for (net, way), (other, crossing) in combinations(ways, 2):
        for ax, ay, bx, by in way:
            for cx, cy, dx, dy in crossing:
                along = (ay == by == cy == dy and max(ax, cx) < min(bx, dx)) or (
                    ax == bx == cx == dx and max(ay, cy) < min(by, dy)
                )
                assert net == other or not along, "two wires look like one"
    minidom.parseString(graph_svg.svg(graph))  # noqa: S318 - own text
    assert graph_text.mermaid(graph).startswith("flowchart LR\n")


@pytest.mark.parametrize("seed", range(40))
def test_any_graph_is_readable(seed):
    must_be_readable(random_graph(seed))


def test_a_loop_closes_at_what_the_robot_measures():
    graph = job_graph(Files(EXAMPLES / "servoing" / "damped.job", Library([])))
    columns = {card.task.name: card.column for card in layout(graph).cards}
    order = ["forward_kin", "damped_ls", "qrint", "qrdiff", "puma_pidg"]
    assert [columns[name] for name in order] == [0, 1, 2, 3, 4]


def test_texts_stay_texts():
    fault = GraphFault(text=EVIL, severity="refuse", tasks=["a"], variables=["X"])
    link = Link(name=EVIL, task="a", variable=EVIL, direction="in", from_=EVIL)
    graph = made(
        [("a", [], ["X"], "r0"), ("b", ["X"], [], "r1")],
        [fault], [link], desc=EVIL, devices=[EVIL],
    )  # fmt: skip
    drawn = graph_svg.svg(structs.replace(graph, name=EVIL), {"a": EVIL})
    root = minidom.parseString(drawn)  # noqa: S318 - own text
    kinds = {one.tagName for one in root.getElementsByTagName("*")}
    assert kinds == {"svg", "title", "style", "rect", "g", "text", "path", "circle"}
    texts = [one.firstChild.data for one in root.getElementsByTagName("text")]
    assert sum("</script>" in one for one in texts) >= 3
    assert not re.search(r"(href|url\(|\son\w+=|@import)", drawn)
    chart = graph_text.mermaid(graph)
    for line in chart.splitlines():
        assert line.count('"') % 2 == 0, line
        assert "<script" not in line
    assert "#60;script#62;" in chart
    assert "\x07" not in chart


def test_faults_states_and_standbys_are_shown():
    fault = GraphFault(
        text="two write X", severity="refuse", tasks=["a"], variables=["X"]
    )
    graph = made([("a", [], ["X"], "r0"), ("b", ["X"], [], "r0")], [fault])
    spare = structs.replace(graph.tasks[1], fallback_of="a")
    graph = structs.replace(graph, tasks=[graph.tasks[0], spare])
    drawn = graph_svg.svg(graph, {"a": "ERROR", "b": "OFF"})
    assert 'class="card faulty"' in drawn
    assert 'class="card spare"' in drawn
    assert "✖ ERROR" in drawn
    assert "○ OFF" in drawn
    assert "! fault: two write X" in drawn
    assert "X !" in drawn
    assert "ERROR> two write X" in graph_text.text(graph)
    assert "class t0 refuse" in graph_text.mermaid(graph)
    calm = graph_svg.svg(made([("a", [], ["X"], "r0")]))
    assert "faulty" not in calm.partition("</style>")[2]


def run(capsys, *words):
    with pytest.raises(SystemExit) as ended:
        cli.main(["graph", *map(str, words)])
    return ended.value.code, *capsys.readouterr()


def test_the_verb_prints_and_draws(capsys, tmp_path):
    job = EXAMPLES / "puma" / "puma.job"
    status, text, _ = run(capsys, job)
    assert status == 0
    assert "    <- T_GRAV          [6] N*m      grav_comp\n" in text
    assert "    -> DH              [6, 4] mixed grav_comp (constant)\n" in text
    status, chart, _ = run(capsys, job, "--mermaid")
    assert status == 0
    assert '-->|"T_GRAV"|' in chart
    assert '-.->|"NDOF, DH"|' in chart
    file = tmp_path / "puma.svg"
    assert run(capsys, job, "--svg", file) == (0, f"{file}\n", "")
    assert "puma_pidg" in file.read_text("utf-8")


def test_the_picture_of_the_page_is_what_is_drawn():
    job = EXAMPLES / "puma" / "puma.job"
    page = EXAMPLES.parent / "docs" / "puma_graph.svg"
    assert page.read_text("utf-8") == graph_svg.svg(job_graph(Files(job, Library([]))))


def test_the_text_of_the_page_is_what_is_printed(capsys):
    page = (EXAMPLES.parent / "docs" / "commands.md").read_text("utf-8")
    shown = page.partition("$ pbonet graph examples/puma/puma.job\n")[2]
    shown = shown.partition("```")[0]
    assert "T_GRAV" in shown
    assert run(capsys, EXAMPLES / "puma" / "puma.job")[1].startswith(shown)


def test_the_verb_refuses_what_it_cannot_draw(capsys, tmp_path):
    folder = EXAMPLES / "puma"
    status, _, error = run(capsys, folder / "puma.sbs")
    assert status == 1
    assert "--running" in error
    assert "puma" in error.partition("jobs: ")[2]
    status, _, error = run(capsys, folder / "puma.job", "--svg", tmp_path / "no" / "x")
    assert status == 1
    assert "the drawing cannot be written" in error
    status, _, error = run(capsys, folder / "puma.job", "--running", "--no-code")
    assert status == 2
    assert "--no-code does not go with --running" in error
