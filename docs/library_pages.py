"""Write the pages of the library out of the modules' own declarations.

``python docs/library_pages.py`` writes a page for each class of modules, and the
reference; a test says when they are no longer what the modules say.
"""

from __future__ import annotations

import inspect
import re
from pathlib import Path
from typing import TYPE_CHECKING

from library_responses import HERE, responds

from pbonet.config import Library
from pbonet.pbo import MODULE_CLASSES
from pbonet.ports import shape_text

if TYPE_CHECKING:
    from collections.abc import Sequence

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
    return found


def _page(
    kind: str, modules: Sequence[LoadedModule], rmods: dict[str, list[str]]
) -> str:
    """Return the page of a class."""
    lines = [
        "<!-- written by docs/library_pages.py; edit the modules, not this -->",
        f"# {TITLES[kind]}",
        "",
        f"Modules of the class *{kind}* in {{doc}}`the library </library>`.",
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
    if responds(module):
        lines += [f"![Response of {info.name}](../_generated/response-{info.name}.svg)"]
        lines += [""]
    own = Path(info.file).parent.name
    files = ", ".join(f"`{name}`" for name in sorted(rmods))
    critical = " May be marked CRITICAL." if info.critical_ok else ""
    source = f"[`{own}/{info.name}.py`](../reference/library.md#{info.name})"
    return [*lines, f"Source: {source}, configured in {files}.{critical}"]


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
        "code. {doc}`/library` lists ports and parameters.",
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
