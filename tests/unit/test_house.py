"""scripts/check_house.py and scripts/room_contract.py find what they should: each rule with a house that breaks it."""

import ast
import tomllib
from pathlib import Path

import pytest

grimp = pytest.importorskip("grimp", reason="import-linter judges the code, not the lowest versions")

from importlinter import fields  # noqa: E402

from scripts import check_house  # noqa: E402
from scripts.room_contract import foreign_imports, parse_house  # noqa: E402

ROOT = Path(__file__).parents[2]
TABLE = ["loaders.model:", "audit.cameras: loaders.model", "(audit.joint): audit.cameras", "audit: audit.cameras"]


def graph_of(*imports: tuple[str, str]):
    graph = grimp.ImportGraph()
    for importer, imported in imports:
        for module in (importer, imported):
            if module not in graph.modules:
                graph.add_module(module)
        graph.add_import(importer=importer, imported=imported, line_number=3, line_contents="import")
    return graph


GOOD = [
    ("p.audit", "p.audit.cameras"),
    ("p.audit.cameras.warps", "p.audit.cameras"),
    ("p.audit.cameras", "p.loaders.model.tables"),
]


def test_a_house_as_in_the_table():
    assert foreign_imports(graph_of(*GOOD), "p", parse_house(TABLE)) == ([], [])


@pytest.mark.parametrize(
    ("importer", "imported", "expected"),
    [
        ("p.loaders.model", "p.audit.cameras.warps", ["loaders.model -> audit.cameras"]),
        ("p.audit", "p.loaders.model.tables", ["audit -> loaders.model"]),  # a door is not the rooms behind it
        ("p.audit.joint.step", "p.audit.cameras", []),
        (
            "p.audit.joint.step",
            "p.loaders.model.tables",
            ["audit.joint -> loaders.model"],
        ),  # what it may is not handed on
    ],
)
def test_an_import_needs_a_word_in_its_row(importer, imported, expected):
    homeless, wrong = foreign_imports(graph_of(*GOOD, (importer, imported)), "p", parse_house(TABLE))
    assert homeless == []
    assert [line.partition("): ")[2] for line in wrong] == expected
    assert all(line.startswith(f"{importer} -> {imported} (l.3)") for line in wrong)


def test_rooms_without_a_row_and_rows_without_a_room():
    house = parse_house([*TABLE, "audit.noise:"])
    homeless, _ = foreign_imports(graph_of(*GOOD, ("p.audit.attic.box", "p.audit.cameras")), "p", house)
    assert homeless == ["p.audit.attic.box has no row", "audit.noise has a row and no module"]


@pytest.mark.parametrize("rows", [["a.b: c.d", "c.d:"], ["a.b: a.b"], ["a.b:", "a.b:"], ["a.b"], [": a.b"]])
def test_a_row_names_rows_above_it(rows):
    with pytest.raises(fields.ValidationError):
        parse_house(rows)


def test_circles_are_found_once_each():
    graph = graph_of(("a", "b"), ("b", "c"), ("c", "a"), ("c", "d"), ("d", "e"), ("e", "d"), ("e", "f"))
    assert check_house.circles(graph) == ["a -> b -> c -> a", "d -> e -> d"]
    assert check_house.circles(graph_of(*GOOD)) == []


def function(name, arguments, num_lines):
    return f"def {name}({arguments}):\n" + "    pass\n" * (num_lines - 1)


def test_functions_on_both_sides_of_the_limits():
    tree = ast.parse(function("fits", "", 50) + function("long", "", 51))
    assert list(check_house.long_functions(tree)) == [("long", 51)]
    methods = (
        "class A:\n    def fits(self, a, b, c, d, e, *, f, g): ...\n    def wide(self, a, b, /, c, d, e, f): ...\n"
    )
    tree = ast.parse(
        methods + function("fits_too", "a, b, c, d, e, *rest, **more", 2) + function("wide_too", "a, b, c, d, e, f", 2)
    )
    assert sorted(check_house.wide_functions(tree)) == [("wide", 6), ("wide_too", 6)]


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    monkeypatch.setattr(check_house, "ROOT", tmp_path)
    monkeypatch.setattr(check_house, "TOO_LONG", {})
    monkeypatch.setattr(check_house, "TOO_MANY_ARGUMENTS", {})
    for folder in ("audit", "tests"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "full.py").write_text("pass\n" * 400)
    return tmp_path


def test_files_on_both_sides_of_the_limit(checkout):
    assert list(check_house.check_sizes()) == []
    for folder in ("audit", "tests"):
        (checkout / folder / "over.py").write_text("pass\n" * 401)
    assert [line.partition(",")[0] for line in check_house.check_sizes()] == [
        "audit/over.py: 401 lines",
        "tests/over.py: 401 lines",
    ]


def test_exceptions_are_needed_or_wrong(checkout, monkeypatch):
    (checkout / "audit" / "wide.py").write_text(function("wide", "a, b, c, d, e, f", 51))
    (checkout / "tests" / "test_wide.py").write_text(function("test_wide", "a, b, c, d, e, f", 3))
    assert [line.split(" ", 2)[:2] for line in check_house.check_sizes()] == [["audit/wide.py:", "wide"]] * 2
    monkeypatch.setattr(check_house, "TOO_LONG", {"audit/wide.py::wide": "so"})
    monkeypatch.setattr(check_house, "TOO_MANY_ARGUMENTS", {"audit/wide.py::wide": "so"})
    assert list(check_house.check_sizes()) == []
    (checkout / "audit" / "wide.py").write_text("")
    assert len(list(check_house.check_sizes())) == 2
    assert all(line.endswith("not needed any more") for line in check_house.check_sizes())


def test_the_picture_leaves_out_what_another_way_says():
    imports = {"audit.a": {"audit.b", "loaders.model"}, "audit.b": {"loaders.model"}, "loaders.model": set()}
    assert check_house.reduced(imports) == {"audit.a": ["audit.b"], "audit.b": ["loaders.model"], "loaders.model": []}
    picture = check_house.draw(imports)
    assert '    audit.a["a"]\n' in picture
    assert "  audit.a --> audit.b\n" in picture
    assert "audit.a --> loaders.model" not in picture


def test_the_picture_is_the_one_of_the_imports(tmp_path, monkeypatch):
    page = tmp_path / "CONTRIBUTING.md"
    page.write_text(f"before\n{check_house.BEGIN}old\n{check_house.END}after\n")
    monkeypatch.setattr(check_house, "PICTURE", page)
    monkeypatch.setattr(check_house, "read_house", lambda: parse_house(TABLE))
    monkeypatch.setattr(check_house, "PACKAGE", "p")
    graph = graph_of(*GOOD)
    assert len(list(check_house.check_picture(graph, write=False))) == 1
    assert list(check_house.check_picture(graph, write=True)) == []
    assert list(check_house.check_picture(graph, write=False)) == []
    text = page.read_text()
    assert text.startswith(f"before\n{check_house.BEGIN}```mermaid\n")
    assert text.endswith(f"```\n{check_house.END}after\n")
    assert "audit.cameras --> loaders.model" in text
    page.write_text("no marks\n")
    with pytest.raises(ValueError, match="no marks"):
        check_house.check_picture(graph, write=True)


def test_every_room_of_the_table_is_named_in_contributing():
    options = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]
    house = parse_house(options["contracts"][0]["rooms"])
    page = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    packages = [room for room in house.allowed if (ROOT / room.replace(".", "/")).is_dir() and "." in room]
    assert len(packages) > 20
    for room in packages:
        folder, _, name = room.partition(".")
        assert f"`{folder}/{name}/`" in page or (folder == "reports" and f"`{name}/`" in page), room
