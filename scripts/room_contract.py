"""A contract of import-linter: what a room may use, and that it is used by its face.

A room is a package; its face is what its ``__init__`` lists for others. The contract
holds for the files directly in the package, not for packages inside it: these are rooms
of their own.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, cast

from importlinter import Contract, ContractCheck, fields, output

if TYPE_CHECKING:
    from grimp import ImportGraph

_WHOLE = re.compile(r"^from \. import (?:\(([^)]*)\)|(.*))", re.MULTILINE)
_NAME = re.compile(r"(\w+) as \w+")
EVERYBODY = ("pbonet", "pbonet.errors", "pbonet.lazy", "pbonet.versions")


def face(room: str) -> set[str]:
    """Return the files of a room that others may use as a whole."""
    listed = Path(*room.split("."), "__init__.pyi")
    text = listed.read_text(encoding="utf-8") if listed.exists() else ""
    return {
        f"{room}.{name}"
        for several, one in _WHOLE.findall(text)
        for name in _NAME.findall(several or one)
    }


def is_package(module: str) -> bool:
    """Return whether a module is a folder."""
    return Path(*module.split(".")).is_dir()


WITH_FOLDERS = ("pbonet.modules", "pbonet.cli")
"""Rooms with folders in them: one for each class of modules, or kind of verbs."""


def room_of(module: str) -> str:
    """Return the room in which a module stands."""
    for room in WITH_FOLDERS:
        if module.startswith(f"{room}."):
            return room
    return module if is_package(module) else module.rpartition(".")[0]


class RoomContract(Contract):
    """One room: what it uses, and how it is used."""

    room = fields.StringField()
    uses = fields.SetField(subfield=fields.StringField(), required=False)

    def check(self, graph: ImportGraph, verbose: bool) -> ContractCheck:  # noqa: ARG002, FBT001
        """Return the imports that break the contract."""
        room = str(self.room)
        uses = cast("set[str] | None", self.uses)
        allowed = {room, *EVERYBODY, *(uses or ())}
        offered = face(room)
        wrong: list[str] = []
        for module in sorted(graph.modules):
            inside = room_of(module) == room
            for used in sorted(graph.find_modules_directly_imported_by(module)):
                if not used.startswith("pbonet"):
                    continue
                if inside and self._home(used) not in allowed:
                    wrong.append(f"{module} uses {used}: {room} may not")
                past = room_of(used) == room and not is_package(used)
                if past and not inside and used not in offered:
                    wrong.append(f"{module} imports {used} past the face of {room}")
        return ContractCheck(kept=not wrong, metadata={"wrong": wrong})

    @staticmethod
    def _home(module: str) -> str:
        """Return the room of a module; of a file at the top its own name."""
        room = room_of(module)
        return module if room == "pbonet" else room

    def render_broken_contract(self, check: ContractCheck) -> None:
        """Print what breaks it."""
        for line in check.metadata["wrong"]:
            output.print_error(line)
