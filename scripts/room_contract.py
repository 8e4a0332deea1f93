"""A contract type for import-linter: which room may import which, as one table in pyproject.toml.

import-linter's own types say what is forbidden; a house with thirty rooms is described shorter by what is allowed. Rows
stand from the ground up: a row may name only rows above it, so the rooms have no circle whatever the table says.

    rooms = ["loaders.arrays:", "loaders.model: loaders.arrays", "(audit.joint): loaders.model"]

A room is a module or a package with all that is in it; a module belongs to the longest name that fits. Parentheses:
the room may be missing. A room that has no row is an error.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from grimp import ImportGraph
from importlinter import Contract, ContractCheck, fields, output
from importlinter.application import contract_utils

Room = str


@dataclass(frozen=True, slots=True)
class House:
    """The table: for each room, from the ground up, what it may import; and the rooms that may be missing."""

    allowed: dict[Room, frozenset[Room]]
    optional: frozenset[Room]

    def room_of(self, module: str) -> Room | None:
        """Return the row that a module without the name of the root package belongs to, None if there is none."""
        parts = module.split(".")
        names = (".".join(parts[:length]) for length in range(len(parts), 0, -1))
        return next((name for name in names if name in self.allowed and (name == module or is_closed(name))), None)


def is_closed(room: Room) -> bool:
    """Whether a row is for all modules in the room; a door (audit, loaders, reports, the root) is only itself."""
    return room.count(".") >= 1


def parse_house(lines: list[str]) -> House:
    """Read the table; raises ``fields.ValidationError`` where a row names itself, or a room that is not above it."""
    allowed: dict[Room, frozenset[Room]] = {}
    optional = set()
    for line in lines:
        name, colon, imports = line.partition(":")
        name = name.strip()
        if name.startswith("(") and name.endswith(")"):
            name = name[1:-1]
            optional.add(name)
        names = frozenset(imports.split())
        if not colon or not name or name in allowed:
            raise fields.ValidationError(f"{line!r}: expected 'room: rooms it may import', each room once")
        if names - allowed.keys():
            raise fields.ValidationError(f"{name}: no row above it for {', '.join(sorted(names - allowed.keys()))}")
        allowed[name] = names
    return House(allowed, frozenset(optional))


class HouseField(fields.Field[House]):
    """The rows of the table."""

    def parse(self, raw_data: str | list[str]) -> House:
        """Read the rows."""
        return parse_house([raw_data] if isinstance(raw_data, str) else raw_data)


def foreign_imports(graph: ImportGraph, root: str, house: House) -> tuple[list[str], list[str]]:
    """Return what breaks the table: modules without a row and rows without a module; imports that no row allows."""
    rooms = {}
    homeless = []
    for module in sorted(graph.modules):
        room = house.room_of(module.removeprefix(f"{root}."))
        if room is None:
            homeless.append(f"{module} has no row")
        else:
            rooms[module] = room
    empty = [room for room in house.allowed if room not in house.optional and room not in rooms.values()]
    homeless += [f"{room} has a row and no module" for room in empty]
    wrong = []
    for module, room in rooms.items():
        for imported in sorted(graph.find_modules_directly_imported_by(module)):
            target = rooms.get(imported, room)
            if target != room and target not in house.allowed[room]:
                lines = {
                    detail["line_number"] for detail in graph.get_import_details(importer=module, imported=imported)
                }
                wrong.append(f"{module} -> {imported} (l.{', l.'.join(map(str, sorted(lines)))}): {room} -> {target}")
    return homeless, wrong


class RoomsContract(Contract):
    """Rooms import only what their row names.

    Configuration options: ``root``, the package; ``rooms``, the rows; ``ignore_imports``, exceptions, by module. An
    exception that is not needed any more is an error, so that the list only shrinks.
    """

    type_name = "rooms"

    root = fields.StringField()
    rooms = HouseField()
    ignore_imports = fields.SetField(subfield=fields.ImportExpressionField(), required=False)

    def check(self, graph: ImportGraph, verbose: bool) -> ContractCheck:  # noqa: ARG002 - import-linter's signature
        """Compare the imports with the table."""
        options: Any = self  # import-linter replaces the fields by their values
        warnings = contract_utils.remove_ignored_imports(
            graph=graph, ignore_imports=options.ignore_imports, unmatched_alerting=contract_utils.AlertLevel.ERROR
        )
        homeless, wrong = foreign_imports(graph, options.root, options.rooms)
        broken = [*homeless, *wrong]
        return ContractCheck(kept=not broken, warnings=warnings, metadata={"broken": broken})

    def render_broken_contract(self, check: ContractCheck) -> None:
        """Print a line for each breach."""
        for line in check.metadata["broken"]:
            output.print_error(f"- {line}", bold=False)
