"""Which small changes of a function are possible? One `Mutant` each, by its syntax tree."""

from __future__ import annotations

import ast
import copy
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

Change = tuple[str, ast.AST, ast.AST]  # of which kind, what stood there, what stands there now


@dataclass(frozen=True, slots=True)
class Target:
    """Functions, methods (Class.method) and module constants of a file that decide; all functions where empty.

    tests: that must notice, below tests/.
    """

    file: str
    tests: tuple[str, ...]
    names: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Mutant:
    """One change: key says where and which, the same as long as the line does not change; source is of the file."""

    key: str
    file: str
    tests: tuple[str, ...]
    source: str
    named: bool = False

    @property
    def module(self) -> str:
        """The module's name."""
        return "sfm_audit." + self.file.removesuffix(".py").replace("/", ".")

    def __str__(self) -> str:
        return self.key


_COMPARED: Final[dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]]] = {
    ast.Lt: (ast.LtE, ast.Gt),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.Lt),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
_OPERATORS: Final[dict[type[ast.operator], type[ast.operator]]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
}
_CALLED: Final = {
    **dict.fromkeys(("max", "amax"), "min"),
    **dict.fromkeys(("min", "median"), "max"),
    "any": "all",
    "all": "any",
    "minimum": "maximum",
    "maximum": "minimum",
    "isnan": "isfinite",
    "isfinite": "isnan",
    "zeros_like": "ones_like",
}
_DROPPED: Final = frozenset({"abs", "sqrt"})  # calls that leave their argument
_WORDS: Final = {
    "REJECTED": "ACCEPTED",
    "ACCEPTED": "UNDETERMINED",
    "UNDETERMINED": "ACCEPTED",
    "HARD": "MEDIUM",
    "MEDIUM": "WEAK",
    "WEAK": "MEDIUM",
}
_MAX_ELEMENTS: Final = 12


def mutants_of(target: Target, root: Path) -> Iterator[Mutant]:
    """Yield the mutants of a file, in the order of its lines."""
    tree = ast.parse((root / target.file).read_text())
    seen: Counter[str] = Counter()
    for name, body in _chosen(tree, target):
        for node in ast.walk(body):
            for kind, old, new in _changes(node):
                mutated = _with(tree, old, new)
                if mutated is None:
                    continue
                key = f"{target.file} {name}: {kind} {_short(old)} -> {_short(new)}"
                seen[key] += 1
                number = f" ({seen[key]})" if seen[key] > 1 else ""
                yield Mutant(key + number, target.file, target.tests, mutated)


def _chosen(tree: ast.Module, target: Target) -> Iterator[tuple[str, ast.AST]]:
    """Functions, methods and constants of the target; all functions and methods if it names none."""
    found: dict[str, ast.AST] = {}
    for node in tree.body:
        if isinstance(node, ast.FunctionDef):
            found[node.name] = node
        elif isinstance(node, ast.ClassDef):
            found[node.name] = ast.Module([each for each in node.body if isinstance(each, ast.AnnAssign)], [])
            found |= {f"{node.name}.{each.name}": each for each in node.body if isinstance(each, ast.FunctionDef)}
        elif isinstance(node, ast.AnnAssign | ast.Assign):
            at = node.target if isinstance(node, ast.AnnAssign) else node.targets[0]
            found[ast.unparse(at)] = ast.Module([ast.Expr(node.value)] if node.value else [], [])
    names = target.names or tuple(name for name, node in found.items() if isinstance(node, ast.FunctionDef))
    if missing := set(names) - set(found):
        raise SystemExit(f"{target.file} has no {', '.join(sorted(missing))}: change scripts/mutation/targets.py")
    return ((name, found[name]) for name in names)


def _changes(node: ast.AST) -> Iterator[Change]:
    """Yield what one node can become."""
    match node:
        case ast.Compare():
            yield from _comparisons(node)
        case ast.BoolOp():
            yield from _conditions(node)
        case ast.Call():
            yield from _calls(node)
        case ast.Tuple(ctx=ast.Load()) | ast.Set() | ast.List(ctx=ast.Load()):
            yield from _elements(node)
        case ast.Dict():
            yield from _entries(node)
        case ast.If() | ast.IfExp():
            yield from ((f"always {value}", node.test, ast.Constant(value)) for value in (True, False))
        case ast.comprehension():
            yield from (("always True", test, ast.Constant(value=True)) for test in node.ifs)
        case _:
            yield from _small_changes(node)


def _small_changes(node: ast.AST) -> Iterator[Change]:
    """Operators, constants, words and what is returned."""
    match node:
        case ast.UnaryOp(op=ast.Not() | ast.USub() | ast.Invert()):
            yield "operator", node, node.operand
        case ast.BinOp(op=op) if type(op) in _OPERATORS:
            yield "operator", node, ast.BinOp(node.left, _OPERATORS[type(op)](), node.right)
        case ast.Constant(value=bool() | int() | float() as value):
            yield "constant", node, ast.Constant(_other(value))
        case ast.Attribute(value=ast.Name(id="Verdict" | "Severity"), attr=word) if word in _WORDS:
            yield "word", node, ast.Attribute(node.value, _WORDS[word], ast.Load())
        case ast.Return(value=ast.expr() as value) if ast.unparse(value) not in {"None", "False"}:
            yield "return", value, ast.Constant(None)


def _conditions(node: ast.BoolOp) -> Iterator[Change]:
    """Yield and for or, and a condition without one of its parts."""
    yield "condition", node, ast.BoolOp(ast.Or() if isinstance(node.op, ast.And) else ast.And(), node.values)
    for k in range(len(node.values)):
        rest = node.values[:k] + node.values[k + 1 :]
        yield "dropped", node, rest[0] if len(rest) == 1 else ast.BoolOp(node.op, rest)


def _elements(node: ast.Tuple | ast.Set | ast.List) -> Iterator[Change]:
    """Yield a display without one of its elements."""
    for k in range(len(node.elts) if len(node.elts) <= _MAX_ELEMENTS else 0):
        changed = copy.copy(node)
        changed.elts = node.elts[:k] + node.elts[k + 1 :]
        yield f"without {_short(node.elts[k])}", node, changed


def _comparisons(node: ast.Compare) -> Iterator[Change]:
    for k, op in enumerate(node.ops):
        for other in _COMPARED[type(op)]:
            yield (
                "comparison",
                node,
                ast.Compare(node.left, [*node.ops[:k], other(), *node.ops[k + 1 :]], node.comparators),
            )


def _calls(node: ast.Call) -> Iterator[Change]:
    """A function for its opposite; |x| for x."""
    name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
    if name in _DROPPED and len(node.args) == 1:
        yield "dropped", node, node.args[0]
    if name in _CALLED:
        changed = copy.copy(node.func)
        setattr(changed, "attr" if isinstance(changed, ast.Attribute) else "id", _CALLED[name])
        yield "call", node, ast.Call(changed, node.args, node.keywords)


def _entries(node: ast.Dict) -> Iterator[Change]:
    for k, key in enumerate(node.keys):
        keys, values = [*node.keys[:k], *node.keys[k + 1 :]], [*node.values[:k], *node.values[k + 1 :]]
        yield f"without {_short(key or node.values[k])}", node, ast.Dict(keys, values)


def _other(value: float) -> float:
    """Another constant: twice the value, 1 for 0, the other truth."""
    if isinstance(value, bool):
        return not value
    return 2 * value if value else 1


class _Replacer(ast.NodeTransformer):
    """Puts one node in the place of another, in a copy: the tree that all mutants share is never changed.

    Not inside of what only has a text: annotations, format strings.
    """

    def __init__(self, old: ast.AST, new: ast.AST) -> None:
        self._old, self._new = old, new
        self.is_done = False

    def visit(self, node: ast.AST) -> ast.AST:
        """Replace the node, or whatever is below it."""
        if node is self._old:
            self.is_done = True
            return self._new
        match node:
            case ast.JoinedStr() | ast.arg():
                return node
            case ast.AnnAssign():
                return self._fields(node, ("value",))
            case ast.FunctionDef():
                return self._fields(node, ("args", "body"))
            case _:
                return self._fields(node, node._fields)

    def _fields(self, node: ast.AST, fields: Iterable[str]) -> ast.AST:
        for field in fields:
            value = getattr(node, field, None)
            if isinstance(value, list):
                fresh = [self.visit(each) if isinstance(each, ast.AST) else each for each in value]
                if any(a is not b for a, b in zip(fresh, value, strict=True)):
                    node = _rebuilt(node, field, fresh)
            elif isinstance(value, ast.AST) and (changed := self.visit(value)) is not value:
                node = _rebuilt(node, field, changed)
        return node


def _with(tree: ast.Module, old: ast.AST, new: ast.AST) -> str | None:
    """Return the source with one node replaced; None where it only has a text."""
    replacer = _Replacer(old, new)
    mutated = replacer.visit(tree)
    return ast.unparse(ast.fix_missing_locations(copy.deepcopy(mutated))) if replacer.is_done else None


def _rebuilt(node: ast.AST, field: str, value: object) -> ast.AST:
    """Return a copy of a node with one field replaced."""
    changed = copy.copy(node)
    setattr(changed, field, value)
    return changed


def _short(node: ast.AST) -> str:
    text = " ".join(ast.unparse(node).split())
    return f"`{text}`" if len(text) <= 90 else f"`{text[:60]} ... {text[-24:]}`"


@dataclass(frozen=True, slots=True)
class Named:
    """A mutant that once survived, or that would do harm: by its text. It must die."""

    name: str
    file: str
    old: str
    new: str
    tests: Sequence[str]

    def mutant(self, root: Path) -> Mutant:
        """Return the mutant; the old text must stand exactly once in the file."""
        source = (root / self.file).read_text()
        if source.count(self.old) != 1:
            raise SystemExit(
                f"{self.file}: the text of the mutant '{self.name}' stands there {source.count(self.old)} x"
            )
        key = f"{self.file} named: {self.name}"
        return Mutant(key, self.file, tuple(self.tests), source.replace(self.old, self.new), named=True)
