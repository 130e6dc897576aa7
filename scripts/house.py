"""How the house stands: files per folder, import circles, imports past a face, lines.

python scripts/house.py            # what is wrong, and the figures
python scripts/house.py --lines    # code lines of each room, too (needs cloc)

Ends with status 1 where a folder holds too many files, or files import each other in a
circle, or a room is used past its face.
"""

from __future__ import annotations

import ast
import json
import re
import shutil
import subprocess
import sys
from collections import defaultdict
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

ROOT: Final = Path(__file__).resolve().parents[1]
MOST_FILES: Final = 31
SOURCES: Final = {".py", ".pyx", ".pxd", ".pxi", ".h", ".pyi"}
OPEN: Final = ("pbonet.cli", "pbonet.modules")
"""Rooms whose files are used one by one: verbs, and modules that RMODs name. They have
folders in them, one for each kind of verbs, or class of modules."""
_LIST = re.compile(r"^from ([\w.]+) import (?:\(([^)]*)\)|(.*))", re.MULTILINE)
_NAME = re.compile(r"(\w+) as \w+")


def _opened(name: str) -> str:
    """Return the open room in which a file or folder stands; empty: in none."""
    return next((room for room in OPEN if name.startswith(f"{room}.")), "")


class Use(NamedTuple):
    """One name that a file imports from pbonet."""

    module: str
    name: str | None
    line: int


class House:
    """The packages below a folder, as their sources say.

    Args:
        root: The folder that holds the package ``pbonet``.
    """

    def __init__(self, root: Path = ROOT) -> None:
        self.root = root
        self.files: dict[str, Path] = {}
        for path in sorted((root / "pbonet").rglob("*.py")):
            parts = path.relative_to(root).with_suffix("").parts
            name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
            self.files[name] = path
        self.rooms = {
            name
            for name, path in self.files.items()
            if path.name == "__init__.py" and not _opened(name)
        }
        self.faces = {room: self._face(room) for room in self.rooms}

    def _face(self, room: str) -> dict[str, str]:
        """Return the names that a room offers, and the file that each comes from."""
        init = self.files[room]
        stub = init.with_suffix(".pyi")
        text = (stub if stub.exists() else init).read_text(encoding="utf-8")
        found: dict[str, str] = {}
        for home, several, one in _LIST.findall(text):
            base = f"{room}{home}" if home.startswith(".") else home
            for name in _NAME.findall(several or one):
                found[name] = f"{room}.{name}" if home == "." else base
        return found

    def room_of(self, module: str) -> str:
        """Return the room of a file; of a file at the top, the file itself."""
        if module in self.rooms:
            return module
        if opened := _opened(module):
            return opened
        room = module.rpartition(".")[0]
        return module if room == "pbonet" else room

    def uses(self, module: str) -> Iterator[Use]:
        """Yield what a file imports from pbonet, within functions, too."""
        path = self.files[module]
        package = module if module in self.rooms else module.rpartition(".")[0]
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom):
                base = node.module or ""
                if node.level:
                    above = package.split(".")[
                        : len(package.split(".")) - node.level + 1
                    ]
                    base = ".".join([*above, *filter(None, [node.module])])
                if base.partition(".")[0] == "pbonet":
                    for one in node.names:
                        yield Use(base, one.name, node.lineno)
            elif isinstance(node, ast.Import):
                for one in node.names:
                    if one.name.startswith("pbonet."):
                        yield Use(one.name, None, node.lineno)

    def home(self, use: Use) -> str:
        """Return the file that a name comes from, through faces."""
        if use.name is None:
            return use.module
        whole = f"{use.module}.{use.name}"
        if whole in self.files and use.module not in self.rooms - {"pbonet"}:
            return whole
        found = self.faces.get(use.module, {}).get(use.name)
        if found is not None and found in self.rooms and found != use.module:
            return self.home(Use(found, use.name, use.line))
        return found or (whole if whole in self.files else use.module)

    def past_faces(self) -> list[str]:
        """Return the imports that reach into another room past its face."""
        wrong: list[str] = []
        for module, path in self.files.items():
            here = self.room_of(module)
            for use in self.uses(module):
                there = self.room_of(use.module)
                inside = {here, use.module, *OPEN}
                if there in inside and use.module not in self.rooms:
                    continue
                whole = f"{use.module}.{use.name}"
                deep = use.module not in self.rooms
                hidden = (
                    use.module != here
                    and use.module not in OPEN
                    and whole in self.files
                    and whole not in self.rooms
                    and use.name not in self.faces.get(use.module, {})
                    and use.module != "pbonet"
                )
                if deep or hidden:
                    place = path.relative_to(self.root)
                    wrong.append(f"{place}:{use.line} imports {whole}")
        return wrong

    def circles(self) -> list[list[str]]:
        """Return the files that import each other in a circle, and rooms that do."""
        files: dict[str, set[str]] = defaultdict(set)
        rooms: dict[str, set[str]] = defaultdict(set)
        for module in self.files:
            if module == "pbonet":
                continue
            for use in self.uses(module):
                home = self.home(use)
                if home not in {module, "pbonet"}:
                    files[module].add(home)
                here, there = self.room_of(module), self.room_of(home)
                if there not in {here, "pbonet"}:
                    rooms[here].add(there)
        return [*_circles(files), *_circles(rooms)]

    def folders(self) -> dict[str, int]:
        """Return how many sources stand in each folder."""
        found: dict[str, int] = defaultdict(int)
        tracked = subprocess.run(
            ["git", "ls-files", "-co", "--exclude-standard", "pbonet"],  # noqa: S607
            cwd=self.root,
            capture_output=True,
            text=True,
            check=True,
        )
        for name in tracked.stdout.splitlines():
            path = Path(name)
            face = path.name == "__init__.pyi"
            if path.suffix in SOURCES and not face and (self.root / path).exists():
                found[str(path.parent)] += 1
        return dict(found)


def _circles(graph: Mapping[str, set[str]]) -> list[list[str]]:
    """Return the strongly connected parts of more than one node (Tarjan 1972)."""
    number: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(node: str) -> None:
        number[node] = low[node] = len(number)
        stack.append(node)
        for other in sorted(graph.get(node, ())):
            if other not in number:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in stack:
                low[node] = min(low[node], number[other])
        if low[node] == number[node]:
            part = stack[stack.index(node) :]
            del stack[stack.index(node) :]
            if len(part) > 1:
                found.append(sorted(part))

    for node in sorted(graph):
        if node not in number:
            visit(node)
    return found


def lines(root: Path) -> dict[str, int] | None:
    """Return the code lines of each folder as cloc counts them; None without cloc."""
    if shutil.which("cloc") is None:
        return None
    command = ["cloc", "--json", "--by-file", "--vcs=git", "--quiet", "pbonet"]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=True)
    found: dict[str, int] = defaultdict(int)
    for name, figures in json.loads(done.stdout).items():
        if name not in {"header", "SUM"}:
            found[str(Path(name).parent).removeprefix("./")] += figures["code"]
    return dict(found)


def main(arguments: list[str]) -> int:
    """Print the figures; return 1 where a rule is broken."""
    house = House()
    folders = house.folders()
    full = max(folders, key=lambda name: folders[name])
    past, circles = house.past_faces(), house.circles()
    print(
        f"files in the fullest folder  {folders[full]:4} ({full}; at most {MOST_FILES})"
    )
    print(f"import circles               {len(circles):4}")
    for part in circles:
        print("   " + " ".join(part))
    print(f"imports past a face          {len(past):4}")
    for line in past:
        print("   " + line)
    if "--lines" in arguments:
        counted = lines(house.root)
        if counted is None:
            print("code lines: cloc is not installed (apt-get install cloc)")
        else:
            print(f"code lines                 {sum(counted.values()):6}")
            for room, number in sorted(counted.items()):
                print(f"   {room:32}{number:6}")
    return int(bool(past or circles) or folders[full] > MOST_FILES)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
