"""Measure the shape of the code: lines against budgets, functions, nesting, names, imports in circles, numbers, words.

    python scripts/house.py                     # of this checkout
    python scripts/house.py OTHER [OTHER ...]   # of other checkouts beside it, one column each

Printed as a table of Markdown. What counts as what stands in the function that counts it.
"""

from __future__ import annotations

import argparse
import ast
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

PACKAGE = "list3r"
Function = ast.FunctionDef | ast.AsyncFunctionDef
BLOCKS = (ast.If, ast.For, ast.AsyncFor, ast.While, ast.With, ast.AsyncWith, ast.Try, ast.Match, *Function.__args__)
BUDGETS = {
    "memory core": (1000, ("memory/core",)),
    "memory store": (3500, ("memory/store",)),
    "memory library": (7500, ("memory/library",)),
    "queries": (3000, ("queries",)),
    "association": (7000, ("association",)),
    "reconstruction": (10000, ("reconstruction",)),
    "frames": (9000, ("frames",)),
    "instances": (5000, ("instances",)),
    "pipeline": (3500, ("pipeline",)),
    "exporters, importers": (5500, ("exporters", "importers")),
    "cli": (3000, ("cli",)),
    "everything else": (10000, ("",)),
}
"""Lines that each room may have, all in, and its files and folders; a file belongs to the first room that names it."""
DECIDING = ("association", "frames", "instances", "memory", "pipeline", "reconstruction", "semantics")
"""Rooms whose numbers decide what a memory holds."""
SMALL = 1e-5
COMMON = set(
    "a an the of and or to in is are be it its as by for with that which what where at on from no not none one each"
    " this they their them has have than so if but all may only more most such how when there into other others"
    " return returns raise raises".split()
)


def measure(root: Path) -> dict[str, str]:
    """Return the figures of a checkout, by name."""
    package = root / PACKAGE
    trees = {path: ast.parse(path.read_text(encoding="utf-8")) for path in sorted(package.rglob("*.py"))}
    lines = {path: path.read_text(encoding="utf-8").count("\n") for path in trees}
    functions = [node for tree in trees.values() for node in ast.walk(tree) if isinstance(node, Function)]
    lengths = sorted(_length(node) for node in functions)
    classes = [n.name for tree in trees.values() for n in ast.walk(tree) if isinstance(n, ast.ClassDef)]
    settings, constants, inline = _deciding_numbers(
        t for p, t in trees.items() if p.relative_to(package).parts[0] in DECIDING
    )
    circles = _circles(_imports(trees, package))
    return {
        "lines": f"{sum(lines.values())}",
        **_against_budgets(lines, package),
        "lines of docstrings": str(sum(_docstring_lines(tree) for tree in trees.values())),
        "files": str(len(trees)),
        "largest file, lines": str(max(lines.values())),
        "classes": str(len(classes)),
        "class names of two classes": str(sum(n > 1 for n in Counter(classes).values())),
        "function length, median / p95": f"{lengths[len(lengths) // 2]} / {lengths[int(0.95 * len(lengths))]}",
        "functions over 6 parameters": str(sum(_parameters(node) > 6 for node in functions)),
        "functions nested four deep": str(sum(_depth(node) >= 4 for node in functions)),
        "circles of imports": str(len(circles)) + "".join(f"; {', '.join(c)}" for c in circles),
        "numbers that decide: settings + constants + inline": f"{settings + constants + inline}"
        f" = {settings} + {constants} + {inline}",
        "most frequent words of docstrings": _words(trees.values()),
    }


def _against_budgets(lines: dict[Path, int], package: Path) -> dict[str, str]:
    out: Counter[str] = Counter()
    for path, count in lines.items():
        name = path.relative_to(package).as_posix()
        out[next(room for room, (_, places) in BUDGETS.items() if any(_within(name, p) for p in places))] += count
    return {f"lines, {room}, of {budget}": str(out[room]) for room, (budget, _) in BUDGETS.items()}


def _within(name: str, place: str) -> bool:
    """Tell whether a file is in a folder, is it, or is one of the files of `folder/*.py`."""
    if place.endswith("/*.py"):
        return name.rpartition("/")[0] == place.removesuffix("/*.py")
    return not place or name == place or name.startswith(f"{place}/")


def _length(node: Function) -> int:
    """Return the lines of a function without its docstring."""
    text = ast.get_docstring(node, clean=False)
    return (node.end_lineno or node.lineno) - node.lineno + 1 - (text.count("\n") + 1 if text else 0)


def _docstring_lines(tree: ast.Module) -> int:
    """Return the lines of docstrings, of fields and constants too."""
    strings = [n for n in ast.walk(tree) if isinstance(n, ast.Expr) and isinstance(n.value, ast.Constant)]
    return len({k for n in strings for k in range(n.lineno, (n.end_lineno or n.lineno) + 1)})


def _parameters(node: Function) -> int:
    a = node.args
    return len([p for p in [*a.posonlyargs, *a.args, *a.kwonlyargs] if p.arg not in ("self", "cls")])


def _depth(node: Function) -> int:
    """Return how many blocks are inside each other at most; inner functions and each elif count."""
    return max((_blocks(child) for child in node.body), default=0)


def _blocks(node: ast.AST) -> int:
    return isinstance(node, BLOCKS) + max((_blocks(child) for child in ast.iter_child_nodes(node)), default=0)


def _deciding_numbers(trees: Iterable[ast.Module]) -> tuple[int, int, int]:
    """Return how many numbers decide results: fields of settings with a number, numeric constants of modules, and
    floats inside functions other than 0, 1, 2, 0.5 and what only keeps a division from zero.
    """
    settings = constants = inline = 0
    for tree in trees:
        inside: dict[int, object] = {}
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef) and node.name.endswith("Settings"):
                fields = [f.value for f in node.body if isinstance(f, ast.AnnAssign) and f.value is not None]
                settings += sum(_is_number(value) for value in fields)
            if isinstance(node, Function):
                inside |= {id(c): c.value for b in node.body for c in ast.walk(b) if isinstance(c, ast.Constant)}
        floats = [v for v in inside.values() if isinstance(v, float)]
        inline += sum(v not in (0.0, 1.0, 2.0, 0.5) and abs(v) > SMALL for v in floats)
        constants += sum(_is_number(value) for value in _constants(tree))
    return settings, constants, inline


def _constants(tree: ast.Module) -> Iterator[ast.expr]:
    """Yield the values of the names in capitals of a module."""
    for node in tree.body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = [t for target in targets for t in (target.elts if isinstance(target, ast.Tuple) else [target])]
            yield from (node.value for t in names if isinstance(t, ast.Name) and t.id.isupper() and len(t.id) > 1)


def _is_number(value: ast.expr) -> bool:
    """Tell whether an expression is a number, a few of them, or worked out from numbers."""
    arithmetic = (ast.Constant, ast.BinOp, ast.UnaryOp, ast.operator, ast.unaryop, ast.Tuple, ast.expr_context)
    parts = list(ast.walk(value))
    held = [p.value for p in parts if isinstance(p, ast.Constant)]
    numbers = [v for v in held if isinstance(v, int | float) and not isinstance(v, bool)]
    return len(numbers) == len(held) > 0 and all(isinstance(p, arithmetic) for p in parts)


def _imports(trees: dict[Path, ast.Module], package: Path) -> dict[str, set[str]]:
    """Return which modules of the package each one imports as it is loaded; those inside of functions count too."""
    names = {path: ".".join(path.relative_to(package.parent).with_suffix("").parts) for path in trees}
    modules = {name for path, name in names.items() if path.name != "__init__.py"}
    out: dict[str, set[str]] = {}
    for path, tree in trees.items():
        if names[path] not in modules:
            continue
        found: set[str] = set()
        for node in _loaded(tree):
            if isinstance(node, ast.ImportFrom) and node.module:
                found |= {node.module, *(f"{node.module}.{a.name}" for a in node.names)}
            elif isinstance(node, ast.Import):
                found |= {a.name for a in node.names}
        out[names[path]] = (found & modules) - {names[path]}
    return out


def _loaded(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the nodes of a module that run, without what stands under `if TYPE_CHECKING`."""
    yield node
    for child in ast.iter_child_nodes(node):
        if not (isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test)):
            yield from _loaded(child)


def _circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Return the groups of modules that import each other in a circle (Tarjan's strongly connected components)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    out: list[list[str]] = []

    def visit(name: str) -> None:
        index[name] = low[name] = len(index)
        stack.append(name)
        for other in sorted(graph[name]):
            if other not in index:
                visit(other)
                low[name] = min(low[name], low[other])
            elif other in stack:
                low[name] = min(low[name], index[other])
        if low[name] == index[name]:
            group = stack[stack.index(name) :]
            del stack[stack.index(name) :]
            if len(group) > 1:
                out.append(sorted(group))

    for name in sorted(graph):
        if name not in index:
            visit(name)
    return out


def _words(trees: Iterable[ast.Module]) -> str:
    """Return the 30 most frequent words of docstrings, but for those of any English text."""
    found: Counter[str] = Counter()
    for tree in trees:
        strings = [n.value for n in ast.walk(tree) if isinstance(n, ast.Expr) and isinstance(n.value, ast.Constant)]
        found.update(w for s in strings if isinstance(s.value, str) for w in re.findall(r"[a-z]{2,}", s.value.lower()))
    common = [(word, n) for word, n in found.most_common() if word not in COMMON][:30]
    return ", ".join(f"{word} {n}" for word, n in common)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("others", nargs="*", type=Path, help="other checkouts to measure beside this one")
    roots = [*parser.parse_args().others, Path(__file__).resolve().parents[1]]
    tables = [measure(root) for root in roots]
    heads = [*(root.name for root in roots[:-1]), "here"]
    print("| " + " | ".join(["", *heads]) + " |")
    print("|---" * (len(heads) + 1) + "|")
    for name in tables[0]:
        print("| " + " | ".join([name, *(table[name] for table in tables)]) + " |")


if __name__ == "__main__":
    main()
