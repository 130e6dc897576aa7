"""The state of the live table, and the effect of each key; it draws nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from .table_rows import COLUMNS, Row, text_of

if TYPE_CHECKING:
    from .table_rows import Cell

VIEWS: Final = tuple(COLUMNS)
HELP: Final = (
    "q quit  Tab view  up/down select  s sort  r reverse  / filter  Enter explain"
)
_PAGE: Final = 10
_STEPS: Final = {
    "up": -1,
    "k": -1,
    "down": 1,
    "j": 1,
    "pageup": -_PAGE,
    "pagedown": _PAGE,
}
_LEAVE: Final = {"escape", "q", "enter", "e"}


class TableView:
    """The view, the order, the filter and the selected row.

    Args:
        sort: The column by which rows are sorted at the beginning; empty: none.
        wanted: The filter at the beginning.
        view: One of `VIEWS`.
    """

    def __init__(self, sort: str = "", wanted: str = "", view: str = "tasks") -> None:
        self.view = view
        self.wanted = wanted
        self.typing = False
        """Whether keys go to the filter."""
        self.reverse = False
        self.ended = False
        self.asked: Row | None = None
        """The row that is to be explained."""
        self.explained = ""
        """The explanation that is shown in place of the table."""
        self.first = 0
        """Its first line that is shown."""
        self._sort = dict.fromkeys(VIEWS, "")
        self._sort[view] = sort
        self._selected = dict.fromkeys(VIEWS, "")
        self._shown: list[Row] = []

    @property
    def sort(self) -> str:
        """The column by which rows are sorted; empty: none."""
        return self._sort[self.view]

    @property
    def place(self) -> int:
        """The number of the selected row among those shown."""
        names = [row.name for row in self._shown]
        selected = self._selected[self.view]
        return names.index(selected) if selected in names else 0

    def shown(self, every: list[Row]) -> list[Row]:
        """Return the rows that are shown, in order.

        Args:
            every: All rows of the view.
        """
        columns = COLUMNS[self.view]
        found = [row for row in every if self._fits(row)]
        names = [column.name for column in columns]
        if self.sort in names:
            index = names.index(self.sort)
            known = [row for row in found if row.cells[index] is not None]
            rest = [row for row in found if row.cells[index] is None]
            known.sort(key=lambda row: _key(row.cells[index]), reverse=self.reverse)
            found = known + rest
        self._shown = found
        if found and self._selected[self.view] not in {row.name for row in found}:
            self._selected[self.view] = found[0].name
        return found

    def _fits(self, row: Row) -> bool:
        columns = COLUMNS[self.view]
        cells = map(text_of, columns, row.cells)
        return self.wanted.lower() in " ".join(cells).lower()

    def press(self, key: str) -> None:
        """Take a key: a character, or a name such as ``up`` or ``enter``."""
        if key == "c-c":
            self.ended = True
        elif self.explained or self.asked is not None:
            if key in _LEAVE:
                self.explained, self.asked = "", None
            elif key in _STEPS:
                self.first = max(self.first + _STEPS[key], 0)
        elif self.typing:
            self._type(key)
        elif key in _STEPS:
            self._move(_STEPS[key])
        else:
            self._command(key)

    def _type(self, key: str) -> None:
        """Change the filter."""
        if key in {"enter", "escape"}:
            self.typing = False
            self.wanted = "" if key == "escape" else self.wanted
        elif key == "backspace":
            self.wanted = self.wanted[:-1]
        elif len(key) == 1 and key.isprintable():
            self.wanted += key

    def _move(self, step: int) -> None:
        if self._shown:
            place = min(max(self.place + step, 0), len(self._shown) - 1)
            self._selected[self.view] = self._shown[place].name

    def _command(self, key: str) -> None:
        match key:
            case "q":
                self.ended = True
            case "tab":
                self.view = VIEWS[(VIEWS.index(self.view) + 1) % len(VIEWS)]
            case "s":
                names = ["", *(column.name for column in COLUMNS[self.view])]
                after = names.index(self.sort) + 1 if self.sort in names else 1
                self._sort[self.view] = names[after % len(names)]
            case "r":
                self.reverse = not self.reverse
            case "/":
                self.typing, self.wanted = True, ""
            case "enter" | "e" if self._shown:
                self.asked, self.first = self._shown[self.place], 0
            case _:
                return


def _key(cell: Cell) -> tuple[bool, float, str]:
    """Return what a cell is sorted by: numbers before texts."""
    if isinstance(cell, str):
        return True, 0.0, cell
    return False, float(cell or 0), ""
