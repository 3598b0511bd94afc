"""Measure the shape of the code: files, lines, layers, long argument lists, deep nesting, constants, duplicate names.

    python scripts/house.py                     # of this checkout
    python scripts/house.py OTHER [OTHER ...]   # of other checkouts beside it, one column each

Printed as a table of Markdown. Lines are also counted room by room:
those that stood at the redesign, and the wings that were built since (`WINGS`).
"""

from __future__ import annotations

import argparse
import ast
import io
import tokenize
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

PACKAGE = "list3r"
Function = ast.FunctionDef | ast.AsyncFunctionDef
WINGS = {
    "adapters, readers and importers": (
        *("frames/readers", "frames/recordings", "frames/writers", "frames/live", "importers", "instances/neural"),
        *("reconstruction/networks", "reconstruction/feedforward", "reconstruction/outputs"),
        *("reconstruction/precomputed.py", "reconstruction/precomputed_files.py", "pipeline/live.py"),
    ),
    "viewer, agents, service, catalogue, batches": (
        *("viewer", "server", "service", "catalog", "batch", "cli/serve", "cli/catalog", "cli/build/batch.py"),
        *("pipeline/workers/cluster.py", "pipeline/workers/ray_pool.py"),
    ),
    "learned discovery, registration by things, one map of a video": (
        *("instances/learned", "association/revisits/constellations", "association/revisits/whole_chunks"),
        *("association/whole_map", "pipeline/chunks/whole_map.py"),
    ),
    "exporters of other programs": (
        *("exporters/cameras", "exporters/meshes", "exporters/prompt", "exporters/report", "exporters/simready"),
        *("exporters/usd", "exporters/parquet.py"),
    ),
}
"""Folders and files of the package that other issues than the redesign added, by what they are."""
BLOCKS = (ast.If, ast.For, ast.AsyncFor, ast.While, ast.With, ast.AsyncWith, ast.Try, ast.Match)


def measure(root: Path) -> dict[str, str]:
    """Return the figures of a checkout, by name."""
    package = root / PACKAGE
    trees = {path: ast.parse(path.read_text(encoding="utf-8")) for path in sorted(package.rglob("*.py"))}
    functions = [node for tree in trees.values() for node in ast.walk(tree) if isinstance(node, Function)]
    lengths = sorted(_length(node) for node in functions)
    classes = {path: [n for n in ast.walk(tree) if isinstance(n, ast.ClassDef)] for path, tree in trees.items()}
    names = Counter(n.name for found in classes.values() for n in found if not n.name.startswith("_"))
    folders = Counter(path.parent for path in trees if path.name != "__init__.py")
    settings = {n.name: n for found in classes.values() for n in found if n.name.endswith("Settings")}
    reached = _reached("BuildSettings", settings)
    constants = [n for tree in trees.values() for n in _constants(tree)]
    counted = {path: _count(path, tree) for path, tree in trees.items()}
    fullest, most = max(folders.items(), key=lambda item: item[1])
    return {
        "lines": _told(counted.values()),
        **{f"lines, {name}": _told(found) for name, found in _by_room(counted, package).items()},
        "files": str(len(trees)),
        "largest file, lines": str(max(lines.all for lines in counted.values())),
        "files in the fullest folder (without `__init__`)": f"{most} (`{fullest.relative_to(root)}`)",
        "folders above 15 files": str(sum(n > 15 for n in folders.values())),
        "layers of files in `memory/`": str(_layers(trees, package)),
        "arrows between rooms of `memory/` that go both ways": str(_both_ways(trees, package)),
        "function length, median / p95": f"{lengths[len(lengths) // 2]} / {lengths[int(0.95 * len(lengths))]}",
        "functions over 6 parameters": str(sum(_parameters(node) > 6 for node in functions)),
        "functions nested four deep": str(sum(_depth(node) >= 4 for node in functions)),
        "constants of modules, numbers among them": f"{len(constants)}, {sum(map(_is_number, constants))}",
        "inline floats other than 0, 1, 2, 0.5": str(sum(_floats(tree) for tree in trees.values())),
        "settings classes, reachable from `BuildSettings`": f"{len(settings)}, {len(reached)}",
        "class names that stand twice": str(sum(n > 1 for n in names.values())),
        "module-level caches": str(sum(_caches(tree) for tree in trees.values())),
    }


@dataclass(frozen=True)
class Lines:
    """Lines of a file."""

    all: int
    code: int
    docstrings: int


def _count(path: Path, tree: ast.Module) -> Lines:
    """Return the lines of a file: all, those with code, and those of docstrings (of fields and constants too)."""
    text = path.read_text(encoding="utf-8")
    strings = [n for n in ast.walk(tree) if isinstance(n, ast.Expr) and isinstance(n.value, ast.Constant)]
    docstrings = {k for n in strings for k in range(n.lineno, (n.end_lineno or n.lineno) + 1)}
    layout = (tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER)
    tokens = (t for t in tokenize.generate_tokens(io.StringIO(text).readline) if t.type not in layout)
    code = {k for t in tokens for k in range(t.start[0], t.end[0] + 1)}
    return Lines(text.count("\n"), len(code - docstrings), len(docstrings))


def _by_room(counted: dict[Path, Lines], package: Path) -> dict[str, list[Lines]]:
    """Return the counts of the files of the redesign, and of those of each wing."""
    out: dict[str, list[Lines]] = {"rooms of the redesign": [], **{wing: [] for wing in WINGS}}
    for path, lines in counted.items():
        name = path.relative_to(package).as_posix()
        wings = (w for w, places in WINGS.items() if any(name == p or name.startswith(f"{p}/") for p in places))
        out[next(wings, "rooms of the redesign")].append(lines)
    return out


def _told(counted: Iterable[Lines]) -> str:
    """Return lines, and how many of them are code and docstrings; the rest is blank or a comment."""
    found = list(counted)
    code, docstrings = sum(lines.code for lines in found), sum(lines.docstrings for lines in found)
    return f"{sum(lines.all for lines in found)} ({code} code, {docstrings} docstrings)"


def _length(node: Function) -> int:
    """Return the lines of a function without its docstring."""
    text = ast.get_docstring(node, clean=False)
    return (node.end_lineno or node.lineno) - node.lineno + 1 - (text.count("\n") + 1 if text else 0)


def _parameters(node: Function) -> int:
    a = node.args
    own = [*a.posonlyargs, *a.args, *a.kwonlyargs]
    return len([p for p in own if p.arg not in ("self", "cls")])


def _depth(node: Function) -> int:
    """Return how many blocks of a function stand inside each other at most; an elif is no deeper than its if."""
    return max((_blocks(child) for child in node.body), default=0)


def _blocks(node: ast.AST) -> int:
    if isinstance(node, Function | ast.ClassDef | ast.Lambda):
        return 0
    deepest = 0
    for name, value in ast.iter_fields(node):
        children = [child for child in (value if isinstance(value, list) else [value]) if isinstance(child, ast.AST)]
        is_elif = (
            name == "orelse" and len(children) == 1 and isinstance(node, ast.If) and isinstance(children[0], ast.If)
        )
        deepest = max([deepest, *(_blocks(child) - is_elif for child in children)])
    return deepest + isinstance(node, BLOCKS)


def _constants(tree: ast.Module) -> list[ast.expr | None]:
    """Return the values of the names in capitals of a module."""
    found = []
    for node in tree.body:
        targets = (
            node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
        )
        names = [t for target in targets for t in (target.elts if isinstance(target, ast.Tuple) else [target])]
        upper = [t for t in names if isinstance(t, ast.Name) and t.id.isupper() and len(t.id) > 1]
        found += [node.value for _ in upper if isinstance(node, ast.Assign | ast.AnnAssign)]
    return found


def _is_number(value: ast.expr | None) -> bool:
    """Tell whether a constant is a number, a few of them, or worked out from numbers."""
    arithmetic = (ast.Constant, ast.BinOp, ast.UnaryOp, ast.operator, ast.unaryop, ast.Tuple, ast.expr_context)
    parts = list(ast.walk(value)) if value is not None else [ast.Name()]
    numbers = [p for p in parts if isinstance(p, ast.Constant) and isinstance(p.value, int | float)]
    return bool(numbers) and all(isinstance(p, arithmetic) and not _is_text(p) for p in parts)


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str | bytes)


def _floats(tree: ast.Module) -> int:
    """Return how many floats stand inside functions."""
    inside = (c for f in ast.walk(tree) if isinstance(f, Function) for b in f.body for c in ast.walk(b))
    values = {id(c): c.value for c in inside if isinstance(c, ast.Constant) and isinstance(c.value, float)}
    return sum(value not in (0.0, 1.0, 2.0, 0.5) for value in values.values())


def _caches(tree: ast.Module) -> int:
    """Return how many dictionaries, weak or not, a module fills while it runs."""
    return sum(
        isinstance(node, ast.Assign | ast.AnnAssign)
        and isinstance(node.value, ast.Call)
        and "Weak" in ast.unparse(node.value.func)
        for node in tree.body
    )


def _reached(name: str, settings: dict[str, ast.ClassDef]) -> set[str]:
    """Return the settings classes that fields lead to."""
    reached: set[str] = set()
    waiting = [name]
    while waiting:
        node = settings.get(waiting.pop())
        if node is None:
            continue
        for field in node.body:
            if isinstance(field, ast.AnnAssign):
                found = {n.id for n in ast.walk(field.annotation) if isinstance(n, ast.Name)} & settings.keys()
                waiting += found - reached
                reached |= found
    return reached


def _imports(trees: dict[Path, ast.Module], package: Path) -> dict[str, set[str]]:
    """Return which modules of `memory/` each one imports."""
    inside = {
        ".".join(path.relative_to(package.parent).with_suffix("").parts): tree
        for path, tree in trees.items()
        if path.is_relative_to(package / "memory") and path.name != "__init__.py"
    }
    out: dict[str, set[str]] = {}
    for name, tree in inside.items():
        found = set()
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module:
                found |= {node.module, *(f"{node.module}.{a.name}" for a in node.names)} & inside.keys()
        out[name] = found - {name}
    return out


def _layers(trees: dict[Path, ast.Module], package: Path) -> int:
    graph = _imports(trees, package)
    layer: dict[str, int] = {}

    def height(name: str) -> int:
        if name not in layer:
            layer[name] = 0
            layer[name] = 1 + max((height(other) for other in graph[name]), default=-1)
        return layer[name]

    return 1 + max(height(name) for name in graph)


def _both_ways(trees: dict[Path, ast.Module], package: Path) -> int:
    def room(name: str) -> str:
        return name.split(".")[2]

    arrows = {(room(a), room(b)) for a, found in _imports(trees, package).items() for b in found if room(a) != room(b)}
    return sum((b, a) in arrows and a < b for a, b in arrows)


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
