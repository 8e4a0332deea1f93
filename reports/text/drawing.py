"""How does a table look in a terminal? One line per row, never wider than the page, names shortened to what is left."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from io import StringIO
from typing import TYPE_CHECKING, Final

from rich import box
from rich.cells import cell_len
from rich.console import Console
from rich.table import Table
from rich.text import Text

from sfm_audit.reports.text.wording import paragraph, shorten

if TYPE_CHECKING:
    from sfm_audit.reports.run_folder.reader import Row

ASCII_HEAD: Final = box.Box("    \n    \n -- \n    \n    \n    \n    \n    \n", ascii=True)
_MIN_NAME: Final = 12
_UNLIMITED: Final = 10_000  # rich never cuts: widths are decided here


@dataclass(frozen=True, slots=True)
class Page:
    """How to draw: columns, whether the terminal knows line-drawing characters, whether it shows colours."""

    width: int = 80
    unicode: bool = True
    colour: bool = False


@dataclass(frozen=True, slots=True)
class Field:
    """One column of a printed table. optional: left out where names would have to be shortened for it."""

    title: str
    show: Callable[[Row], str]
    style: Callable[[Row], str] = lambda _: ""
    numeric: bool = True
    optional: bool = False


@dataclass(frozen=True, slots=True)
class Listing:
    """Rows to print: the table's title, the first column's title and its names, in pieces from general to special."""

    title: str
    first: str
    names: Sequence[Sequence[str]]
    rows: Sequence[Row]


def draw(listing: Listing, fields: Sequence[Field], page: Page) -> str:
    """Draw a table whose first column, of names, takes what the others leave."""
    widths = [_width(field, listing.rows) for field in fields]
    wanted = max((cell_len(" ".join(name)) for name in listing.names), default=0)
    if any(field.optional for field in fields) and wanted + sum(widths) > page.width:
        return draw(listing, [field for field in fields if not field.optional], page)
    cells = [[field.show(row) for field in fields] for row in listing.rows]
    names = [_fit(name, max(_MIN_NAME, page.width - sum(widths))) for name in listing.names]
    table = Table(box=box.SIMPLE_HEAD if page.unicode else ASCII_HEAD, padding=0, pad_edge=False, show_edge=False)
    table.add_column(listing.first, no_wrap=True, vertical="bottom")
    for field in fields:
        table.add_column(field.title, justify="right" if field.numeric else "left", no_wrap=True)
    for name, row, texts in zip(names, listing.rows, cells, strict=True):
        table.add_row(Text(name), *(Text(text, field.style(row)) for field, text in zip(fields, texts, strict=True)))
    drawn = StringIO()
    console = Console(file=drawn, width=_UNLIMITED, force_terminal=page.colour, legacy_windows=False)
    console.print(table)
    return "\n".join(
        [paragraph(listing.title, page.width), *(line.rstrip() for line in drawn.getvalue().splitlines()), ""]
    )


def _width(field: Field, rows: Sequence[Row]) -> int:
    """Cells that a column takes, the space before it included."""
    return 1 + max(*map(len, field.title.split("\n")), *(len(field.show(row)) for row in rows), 0)


def _fit(name: Sequence[str], width: int) -> str:
    """Shorten a name to a width; of a model and an image in it, the image keeps at least half."""
    if len(name) == 1 or cell_len(" ".join(name)) <= width:
        return shorten(" ".join(name), width)
    model = shorten(name[0], max(width // 2, width - cell_len(name[1]) - 1))
    return f"{model} {shorten(name[1], width - cell_len(model) - 1)}"
