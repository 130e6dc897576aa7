"""``pbonet graph``: the tasks of a job and the variables that connect them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated as A

from . import options
from .parser import Argument, Option, UsageError


def command(
    *,
    file: A[Path, Argument("The .job file; with --running also a .sbs file.")],
    svg: A[Path | None, Option("Draw it into a file.", "FILE")] = None,
    mermaid: A[bool, Option("Print it as a Mermaid flowchart.")] = False,
    running: A[
        bool, Option("Ask the agents, and draw the tasks that exist now.")
    ] = False,
    no_code: A[
        bool, Option("Import no module: units and sizes are those of the table.")
    ] = False,
    place: options.Watching,
    json_: options.Json = False,
) -> None:
    """Show the tasks of a job and the variables that connect them.

    Without an option it prints what each task reads and writes, and which task is at
    the other end. The drawing has a card for each task and a frame for each RTPU;
    faults that 'pbonet check' finds are marked. Modules are imported, so their code
    runs: use --no-code for files that you do not trust.

    Examples:
        Draw a job, for a browser or a document:
        pbonet graph puma.job --svg puma.svg
        Print a flowchart for a page that draws Mermaid:
        pbonet graph puma.job --mermaid
        Draw the tasks that exist now, with their states:
        pbonet graph puma.sbs --running --svg now.svg
    """
    import msgspec

    from pbonet.master.configuration import graph_text
    from pbonet.master.tools import draw_graph

    if running and no_code:
        raise UsageError(
            "--no-code does not go with --running: agents know the modules"
        )
    if running:
        drawn = draw_graph.running(file, place)
    else:
        drawn = draw_graph.planned(file, place, code=not no_code)
    graph = drawn.graph
    if svg is not None:
        draw_graph.write_svg(drawn, svg)
    data = msgspec.to_builtins(graph)
    data |= {"states": drawn.states, "files": [str(svg)] if svg else []}
    text = graph_text.mermaid(graph) if mermaid else graph_text.text(graph)
    if svg is not None and not mermaid:
        text = str(svg)
    options.show_warned(text, data, drawn.warnings, as_data=json_)
