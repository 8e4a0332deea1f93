"""No module imports itself by way of others, imports inside functions included."""

import sys
from pathlib import Path

import pytest

grimp = pytest.importorskip("grimp")  # comes with import-linter, which the lowest versions are tested without


def circles(package: str) -> list[list[str]]:
    """Groups of modules that import each other, directly or not: Tarjan's strongly connected components."""
    graph = grimp.build_graph(package, cache_dir=None)
    order: dict[str, int] = {}
    lowest: dict[str, int] = {}
    open_modules: list[str] = []
    found = []

    def visit(module: str) -> None:
        order[module] = lowest[module] = len(order)
        open_modules.append(module)
        for imported in sorted(graph.find_modules_directly_imported_by(module)):
            if imported not in order:
                visit(imported)
                lowest[module] = min(lowest[module], lowest[imported])
            elif imported in open_modules:
                lowest[module] = min(lowest[module], order[imported])
        if lowest[module] == order[module]:
            at = open_modules.index(module)
            if len(open_modules) - at > 1:
                found.append(sorted(open_modules[at:]))
            del open_modules[at:]

    for module in sorted(graph.modules):
        if module not in order:
            visit(module)
    return found


def test_no_module_imports_itself_by_way_of_others():
    assert circles("sfm_audit") == []


def test_a_circle_through_a_function_is_found(tmp_path: Path, monkeypatch):
    package = tmp_path / "toy_package_with_a_circle"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "a.py").write_text("from toy_package_with_a_circle import b\n")
    (package / "b.py").write_text("def late():\n    from toy_package_with_a_circle import c\n    return c\n")
    (package / "c.py").write_text("import toy_package_with_a_circle.a\n")
    (package / "d.py").write_text("from toy_package_with_a_circle import a\n")
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    name = package.name
    assert circles(name) == [[f"{name}.a", f"{name}.b", f"{name}.c"]]
