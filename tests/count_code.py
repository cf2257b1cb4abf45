"""Counts of the code: modules, lines, long signatures, constants of planning, names with two meanings.

    python tests/count_code.py

Lines are those of code: without comments, docstrings and blank lines. A constant of planning is a name in capitals that
a module there sets to a number, or to a tuple of numbers; those of the modules on time, memory and disk are measured
costs, not tuned.
"""

from __future__ import annotations

import ast
import io
import tokenize
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LAYOUT = {
    tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER,
    tokenize.ENCODING,
}  # fmt: skip
MANY = 10  # parameters
COSTS = {
    "effort",
    "memory",
    "disk",
    "stage_memory",
    "stage_work",
    "worker_memory",
    "written_bytes",
}  # modules of planning whose constants are measured


def code_lines(source: str, tree: ast.AST) -> int:
    """Count lines of code."""
    lines: set[int] = set()
    for token in tokenize.tokenize(io.BytesIO(source.encode()).readline):
        if token.type not in LAYOUT:
            lines.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node) is not None:
            text = node.body[0]
            lines -= set(range(text.lineno, (text.end_lineno or text.lineno) + 1))
    return len(lines)


def is_number(node: ast.AST | None) -> bool:
    """Tell whether an expression is a number, or a tuple of numbers."""
    if isinstance(node, ast.Tuple):
        return bool(node.elts) and all(map(is_number, node.elts))
    parts = list(ast.walk(node)) if node is not None else []
    plain = ast.Constant | ast.UnaryOp | ast.BinOp | ast.operator | ast.unaryop | ast.expr_context
    return any(isinstance(part, ast.Constant) for part in parts) and all(
        (isinstance(part, plain) and (not isinstance(part, ast.Constant) or isinstance(part.value, int | float)))
        or (isinstance(part, ast.Name) and part.id == "MIB")
        for part in parts
    )


def constants(tree: ast.Module) -> list[str]:
    """List the names in capitals that a module sets to numbers, one by one or several at once."""
    found: list[str] = []
    for node in tree.body:
        if not isinstance(node, ast.Assign):
            continue
        target = node.targets[0]
        several = isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple)
        pairs = zip(target.elts, node.value.elts, strict=True) if several else [(target, node.value)]
        found += [
            name.id for name, value in pairs if isinstance(name, ast.Name) and name.id.isupper() and is_number(value)
        ]
    return found


def main() -> None:
    """Print the counts."""
    for folder in ("blocksar", "tests"):
        paths = sorted(path for path in (ROOT / folder).rglob("*.py") if "__pycache__" not in path.parts)
        sources = {path: path.read_text(encoding="utf-8") for path in paths}
        trees = {path: ast.parse(source) for path, source in sources.items()}
        lines = sum(code_lines(source, trees[path]) for path, source in sources.items())
        print(f"{folder}: {len(paths)} modules, {lines} lines of code")
        if folder != "blocksar":
            continue
        many = [
            node.name
            for tree in trees.values()
            for node in ast.walk(tree)
            if isinstance(node, ast.FunctionDef)
            and len(node.args.posonlyargs) + len(node.args.args) + len(node.args.kwonlyargs) >= MANY
        ]
        found = {path.stem: constants(tree) for path, tree in trees.items() if {"planning", "dwells"} & {*path.parts}}
        costs = sum(len(found[name]) for name in COSTS)
        tuned = sum(map(len, found.values())) - costs
        print(f"  functions with {MANY} parameters or more: {len(many)}")
        print(f"  constants of planning: {tuned}, and {costs} measured costs")
        modules, classes = defaultdict(set), defaultdict(set)
        for path, tree in trees.items():
            if not path.name.startswith("__"):
                modules[path.stem].add(path.parent.name)
            for node in tree.body:
                if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                    classes[node.name].add(path.stem)
        for kind, names in (("modules", modules), ("classes", classes)):
            twice = sorted(name for name, places in names.items() if len(places) > 1)
            print(f"  {kind} of one name: {len(twice)}: {', '.join(twice)}")


if __name__ == "__main__":
    main()
