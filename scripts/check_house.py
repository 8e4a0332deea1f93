"""Is the house as it should be? No import circle, no file or function too long; and its picture in CONTRIBUTING.md.

Without arguments the picture is drawn anew; with --check it must be what would be drawn. Which room may import which is
import-linter's business (pyproject.toml); the picture shows what is imported.
"""

from __future__ import annotations

import argparse
import ast
import sys
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Final

import grimp

from scripts.room_contract import House, parse_house

ROOT: Final = Path(__file__).resolve().parents[1]
FOLDERS: Final = ("audit", "loaders", "reports", "sfm_audit", "scripts", "tests")
PACKAGE: Final = "sfm_audit"
PICTURE: Final = ROOT / "CONTRIBUTING.md"
BEGIN: Final = "<!-- made by scripts/check_house.py from the imports -->\n"
END: Final = "<!-- end of the picture -->\n"
MAX_FILE_LINES: Final = 400
MAX_FUNCTION_LINES: Final = 50
MAX_POSITIONAL: Final = 5
# Exceptions, each with its reason. One that is not needed any more is an error, so that the list only shrinks.
TOO_LONG: Final[Mapping[str, str]] = {
    "audit/calibrate/validation.py::validate": "fills a record of 18 numbers, a line each",
}
TOO_MANY_ARGUMENTS: Final[Mapping[str, str]] = {
    "audit/engine/rows.py::model_row": "gathers what six rooms know of a model",
}
MODEL_ROOMS: Final = ("loaders.arrays", "loaders.camera_models", "loaders.errors", "loaders.model")  # one box


def sources() -> Iterator[Path]:
    """Python files of the repository; the links in sfm_audit/ are not followed."""
    for folder in FOLDERS:
        yield from sorted(path for path in (ROOT / folder).rglob("*.py") if "__pycache__" not in path.parts)


def long_functions(tree: ast.Module) -> Iterator[tuple[str, int]]:
    """Functions over the limit, with their lines; the docstring counts, decorators do not."""
    for node in functions(tree):
        num_lines = (node.end_lineno or node.lineno) - node.lineno + 1
        if num_lines > MAX_FUNCTION_LINES:
            yield node.name, num_lines


def wide_functions(tree: ast.Module) -> Iterator[tuple[str, int]]:
    """Functions over the limit of positional arguments, with their number; self and cls do not count."""
    for node in functions(tree):
        names = [argument.arg for argument in (*node.args.posonlyargs, *node.args.args)]
        num_positional = len(names) - (names[:1] in (["self"], ["cls"]))
        if num_positional > MAX_POSITIONAL:
            yield node.name, num_positional


def functions(tree: ast.Module) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    """Functions and methods, nested ones too."""
    return (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef))


def check_sizes() -> Iterator[str]:
    """Say what is too long or takes too much; tests may take as many fixtures as they need."""
    long, wide = dict(TOO_LONG), dict(TOO_MANY_ARGUMENTS)
    for path in sources():
        name, text = path.relative_to(ROOT).as_posix(), path.read_text(encoding="utf-8")
        num_lines = text.count("\n")
        if num_lines > MAX_FILE_LINES:
            yield f"{name}: {num_lines} lines, at most {MAX_FILE_LINES} allowed; two questions make two files"
        tree = ast.parse(text, name)
        for function, number in long_functions(tree):
            if long.pop(f"{name}::{function}", None) is None:
                yield f"{name}: {function} has {number} lines, at most {MAX_FUNCTION_LINES} allowed"
        for function, number in wide_functions(tree):
            if not name.startswith("tests/") and wide.pop(f"{name}::{function}", None) is None:
                yield f"{name}: {function} takes {number} positional arguments, at most {MAX_POSITIONAL} allowed"
    for needless in (*long, *wide):
        yield f"scripts/check_house.py: the exception for {needless} is not needed any more"


def circles(graph: grimp.ImportGraph) -> list[str]:
    """Return the import circles among modules, imports inside functions too; each once, by its shortest way round."""
    found: dict[frozenset[str], str] = {}
    for module in sorted(graph.modules):
        for imported in sorted(graph.find_modules_directly_imported_by(module)):
            back = graph.find_shortest_chain(imported, module)
            if back is not None:
                found.setdefault(frozenset(back), " -> ".join((module, *back)))
    return list(found.values())


def room_imports(graph: grimp.ImportGraph, house: House) -> dict[str, set[str]]:
    """Return which room imports which; the basic modules of loaders are one room, the doors are none."""
    imports: dict[str, set[str]] = {}
    for module in graph.modules:
        here = _box(house, module)
        if here is not None:
            targets = {_box(house, imported) for imported in graph.find_modules_directly_imported_by(module)}
            imports.setdefault(here, set()).update(target for target in targets if target not in (None, here))
    return imports


def _box(house: House, module: str) -> str | None:
    room = house.room_of(module.removeprefix(f"{PACKAGE}."))
    if room is None or "." not in room:
        return None
    return "loaders.model" if room in MODEL_ROOMS else room


def reduced(imports: Mapping[str, set[str]]) -> dict[str, list[str]]:
    """Leave out an import that another way already leads to; raises RecursionError where rooms have a circle."""

    def below(room: str) -> set[str]:
        return imports[room] | {lower for target in imports[room] for lower in below(target)}

    return {
        room: sorted(t for t in targets if not any(t in below(other) for other in targets - {t}))
        for room, targets in imports.items()
    }


def draw(imports: Mapping[str, set[str]]) -> str:
    """Return the picture as a Mermaid flow chart: a box per room, an arrow to what it imports."""
    lines = ["```mermaid", "flowchart TD"]
    for folder in ("reports", "audit", "loaders"):
        lines.append(f"  subgraph {folder}")
        for room in sorted(room for room in imports if room.startswith(f"{folder}.")):
            words = "model, errors, arrays, camera_models" if room == "loaders.model" else room.partition(".")[2]
            lines.append(f'    {room}["{words}"]')
        lines.append("  end")
    lines += [f"  {room} --> {target}" for room, targets in sorted(reduced(imports).items()) for target in targets]
    return "\n".join([*lines, "```", ""])


def with_picture(page: str, picture: str) -> str:
    """Put the picture between its marks; ValueError where the page has none."""
    before, _, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not end:
        raise ValueError(f"no marks {BEGIN.strip()} and {END.strip()}")
    return before + BEGIN + picture + END + after


def read_house() -> House:
    """Read the table of rooms in pyproject.toml."""
    options = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]
    return parse_house(next(contract["rooms"] for contract in options["contracts"] if contract["type"] == "rooms"))


def check_picture(graph: grimp.ImportGraph, *, write: bool) -> Iterable[str]:
    """Draw the picture into CONTRIBUTING.md, or say that the one that is there is old."""
    page = PICTURE.read_text(encoding="utf-8")
    now = with_picture(page, draw(room_imports(graph, read_house())))
    if now == page:
        return []
    if not write:
        return [f"{PICTURE.name}: the picture of the house is old; run scripts/check_house.py"]
    PICTURE.write_text(now, encoding="utf-8")
    return []


def main() -> int:
    """Check and draw; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing, fail when the picture is old")
    arguments = parser.parse_args()
    sys.path.insert(0, str(ROOT))  # grimp looks at the files; nothing of the package is imported
    graph = grimp.build_graph(PACKAGE, cache_dir=None)
    wrong = [*check_sizes(), *(f"import circle: {way}" for way in circles(graph))]
    wrong += check_picture(graph, write=not arguments.check)
    for line in wrong:
        print(line, file=sys.stderr)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
