"""Write the pages of the library out of the modules' own declarations.

``python docs/library_pages.py`` writes a page for each class of modules, and the
reference; a test says when they are no longer what the modules say.
"""

from __future__ import annotations

import inspect
import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from library_responses import HERE, reacts, responds

from pbonet.config import Library
from pbonet.pbo import MODULE_CLASSES
from pbonet.ports import shape_text

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pbonet.config.library import LoadedModule

TITLES = {
    "controller": "Controllers",
    "robot interface": "Robot interfaces",
    "kinematics": "Kinematics",
    "trajectory": "Trajectories",
    "sensor": "Sensors and estimation",
    "teleoperation": "Teleoperation",
    "signal": "Signals",
    "connector": "Connectors",
    "subsystem interface": "Subsystem interfaces",
}
"""The title of each class's page, in the order of the library."""
FOLDERS = {
    kind: re.sub(" and .*", "", title.lower()).replace(" ", "_")
    for kind, title in TITLES.items()
}
"""The folder of each class in ``pbonet/modules``, and the name of its page."""
MEASURED = HERE / "benchmarks" / "library.json"
"""The figures of `benchmarks.library`."""
US = "\N{MICRO SIGN}s"
_SECTIONS = re.compile(r"^(Args|Attributes|Raises|Returns):", re.MULTILINE)
_MARKS = re.compile(r"([*_<>\[\]])")


def built_in() -> dict[str, LoadedModule]:
    """Return pbonet's own modules by name."""
    library = Library()
    own = Path(library.files()["diff"]).parents[1]
    return {
        name: library.load(name)
        for name, path in library.files().items()
        if path.is_relative_to(own)
    }


def pages() -> dict[Path, str]:
    """Return the text of every generated page, by its file."""
    modules = built_in()
    rmods: dict[str, list[str]] = {}
    for name, record in Library().records().items():
        for part in record.module.split("+"):
            rmods.setdefault(part, []).append(f"{name}.rmod")
    found = {
        HERE / "library" / f"{FOLDERS[kind]}.md": _page(
            kind,
            [one for one in modules.values() if one.info.module_class == kind],
            rmods,
        )
        for kind in MODULE_CLASSES
    }
    found[HERE / "reference" / "library.md"] = _reference(modules)
    found[MEASURED.with_suffix(".md")] = _measured_page(measured())
    return found


def measured() -> dict[str, dict[str, Any]]:
    """Return what `benchmarks.library` measured, by module."""
    found: dict[str, dict[str, Any]] = json.loads(MEASURED.read_text(encoding="utf-8"))
    return found


def _page(
    kind: str, modules: Sequence[LoadedModule], rmods: dict[str, list[str]]
) -> str:
    """Return the page of a class."""
    lines = [
        "<!-- written by docs/library_pages.py; edit the modules, not this -->",
        f"# {TITLES[kind]}",
        "",
        f"Modules of the class *{kind}* in [the library](../library.md).",
        "",
    ]
    rows = [
        (f"[`{one.info.name}`](#{one.info.name})", _plain(one.info.doc))
        for one in modules
    ]
    lines += _table("| module | what it does |", rows) if rows else ["None yet."]
    for one in modules:
        lines += ["", *section(one, rmods.get(one.info.name, []))]
    return "\n".join(lines).rstrip() + "\n"


def section(module: LoadedModule, rmods: Sequence[str]) -> list[str]:
    """Return what a page says about one module."""
    info = module.info
    text = _SECTIONS.split(inspect.getdoc(module.cls) or "")[0].strip()
    lines = [f"## {info.name}", "", _plain(text), ""]
    lines += _table(
        "| port | kind | shape | unit | what it carries |",
        [
            (f"`{p.name}`", str(p.kind), shape_text(p.shape), p.unit, _plain(p.doc))
            for p in info.ports
        ],
    )
    if info.params:
        lines += _table(
            "| LOCAL | values | unit | bounds | default | meaning |",
            [
                (
                    f"`{p.name.upper()}`",
                    p.type,
                    p.unit,
                    p.bounds.replace("|", "\\|"),
                    "required" if p.required else f"`{p.default}`" * bool(p.default),
                    _plain(p.doc),
                )
                for p in info.params
            ],
        )
    if responds(module) or reacts(module):
        lines += [f"![Response of {info.name}](../_generated/response-{info.name}.svg)"]
        lines += [""]
    own = Path(info.file).parent.name
    files = ", ".join(f"`{name}`" for name in sorted(rmods))
    critical = " May be marked CRITICAL." if info.critical_ok else ""
    source = f"[`{own}/{info.name}.py`](../reference/library.md#{info.name})"
    lines += [_maxc(measured().get(info.name, {})), ""]
    return [*lines, f"Source: {source}, configured in {files}.{critical}"]


def _maxc(found: Mapping[str, Any]) -> str:
    """Return what the measured execution time of a module is, and of which machine."""
    if "p99" not in found:
        why = found.get("missing", "`python -m benchmarks.library --save` measures it")
        return f"MAXC: not measured ({_plain(why)})."
    size = f", {found['size']}" if found["size"] else ""
    return (
        f"MAXC: of {found['cycles']} cycles 99 in 100 took at most {found['p99']:.0f} "
        f"{US} of CPU time, half of them {found['p50']:.0f} {US}, the longest "
        f"{found['max']} {US}{size}; {found['machine']}. That of your machine: "
        "[`pbonet profile`](../commands.md#execution-times-profile-adopt-check-"
        "simulate)."
    )


def _measured_page(modules: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the page with the measured times of all modules."""
    rows = [
        (
            f"`{name}`",
            str(found.get("size", "")),
            f"{1e6 / found['hz']:.0f}" if "hz" in found else "",
            f"{found['p50']:.1f}" if "p50" in found else _plain(found["missing"]),
            f"{found['p99']:.0f}" if "p99" in found else "",
            str(found.get("max", "")),
            f"{found['bare']:.1f}" if "bare" in found else "",
            _growth(found.get("growth")),
            ", ".join(found["missed"]),
            found["machine"].rpartition(" ")[2],
        )
        for name, found in sorted(modules.items())
    ]
    machines = {found["machine"].rpartition(", ")[0] for found in modules.values()}
    return "\n".join([
        "<!-- written by docs/library_pages.py; from what is measured -->",
        "# Modules of the library",
        "",
        "    python -m benchmarks.library --grow 20000 --save",
        "    python docs/library_pages.py",
        "",
        f"CPU time of `cycle` on a bench, in {US}, with inputs that move in each one. "
        f"Machine: {'; '.join(sorted(machines))}.",
        "Other programs ran beside it, as many as the load average says: that inflates "
        "p99 and the longest.",
        f"Goals: p99 at most a fifth of the period (200 {US} at 1 kHz); p50 at most "
        f"5 {US} above the bare call of the module's library; no memory that grows ("
        "300 blocks or 256 KiB are taken for what is kept once). A row says which of "
        "them (p99, overhead, memory) its module misses.",
        "",
        *_table(
            "| module | sizes | period | p50 | p99 | longest | the library's call, p50 "
            "| memory not given back after the cycles | goal missed | load |",
            rows,
        ),
    ])


def _growth(found: Mapping[str, int] | None) -> str:
    """Return the memory that a module's cycles did not give back."""
    if found is None:
        return ""
    return f"{found['blocks']} blocks, {found['kib']} KiB ({found['cycles']})"


def _table(head: str, rows: Sequence[tuple[str, ...]]) -> list[str]:
    return [
        head,
        "|" + "---|" * (head.count("|") - 1),
        *("| " + " | ".join(cell or " " for cell in row) + " |" for row in rows),
        "",
    ]


def _plain(text: str) -> str:
    """Return a docstring's text so that Markdown takes none of it as a mark."""
    parts = re.split(r"(`+[^`]+`+)", text)
    return "".join(
        part if part.startswith("`") else _MARKS.sub(r"\\\1", part) for part in parts
    ).replace("|", "\\|")


def _reference(modules: dict[str, LoadedModule]) -> str:
    """Return the page with the code of each module."""
    lines = [
        "<!-- written by docs/library_pages.py -->",
        "# The library's modules",
        "",
        "One class in each file; the class docstring gives the law, `[source]` the "
        "code. [The library](../library.md) lists ports and parameters.",
        "",
        *_directive("pbonet.modules", "no-members"),
    ]
    for name, module in modules.items():
        lines += ["", f"## {name}", ""]
        lines += _directive(module.cls.__module__, "members", "undoc-members")
    return "\n".join(lines) + "\n"


def _directive(name: str, *options: str) -> list[str]:
    told = [f"   :{option}:" for option in options]
    return ["```{eval-rst}", f".. automodule:: {name}", *told, "```"]


def main() -> None:
    """Write the pages."""
    for path, text in pages().items():
        path.parent.mkdir(exist_ok=True)
        path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
