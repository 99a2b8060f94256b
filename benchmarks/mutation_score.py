"""How many small faults in the projection and the step the tests notice: the mutation score.

    python benchmarks/mutation_score.py [--count 400] [--seed 1] [--module engine/step] [--json FILE]

One fault at a time is written into a copy of the package: an operator or a number changed, a comparison moved by its
boundary or turned round, a condition negated, a statement left out. Fast tests then run without the JIT until one
fails. What no test notices is listed; docs/mutation-score.md says what has become of it.

A mutant is a child forked from a parent that has imported the libraries, so that it costs as long as its tests take.
That, and the decorators, are why this is no library: mutmut leaves decorated functions out, and nearly all here are;
cosmic-ray edits the sources in place and starts a new interpreter for each mutant, seconds for Numba and SciPy alone.
"""

from __future__ import annotations

import argparse
import ast
import copy
import importlib
import json
import multiprocessing
import os
import random
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
MODULES = ("engine/step", "engine/kernels", "core/project")
TESTS = (
    "engine/test_kernels",
    "core/test_second_tries",
    "core/test_nystrom_methods",
    "core/test_properties",
    "core/test_guards",
    "core/test_adaptive",
    "run/test_integrate",
    "app/test_tables",
    "core/test_units",
    "acceptance/test_bad_input",
)
MARKERS = "not slow and not needs_jit and not slow_without_jit"
PRELOADED = ("numba", "scipy.integrate", "scipy.optimize", "mpmath", "pytest")
LOG, KILLER = "log.txt", "killer.txt"
MEMORY = 8 << 30  # a mutant that grows without end must not take the machine with it

BOUNDARY = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt}
OPPOSITE = {
    ast.Lt: ast.GtE, ast.LtE: ast.Gt, ast.Gt: ast.LtE, ast.GtE: ast.Lt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is,
}  # fmt: skip
ARITHMETIC = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult, ast.Pow: ast.Mult,
}  # fmt: skip
SWAPPED = {"min": "max", "max": "min"}
DROPPED = {"abs", "sqrt"}


class Mutant(NamedTuple):
    """One fault: the source of the whole module with it."""

    module: str
    line: int
    change: str
    source: str


def with_fields(node: ast.AST, **fields) -> ast.AST:
    """A copy of the node with other fields."""
    other = copy.copy(node)
    for name, value in fields.items():
        setattr(other, name, value)
    return other


def compared(node: ast.Compare) -> Iterator[ast.AST]:
    """Each comparison moved by its boundary, then turned round."""
    for k, op in enumerate(node.ops):
        for table in (BOUNDARY, OPPOSITE):
            if type(op) in table:
                yield with_fields(node, ops=[*node.ops[:k], table[type(op)](), *node.ops[k + 1 :]])


def called(node: ast.Call) -> Iterator[ast.AST]:
    name = node.func.id if isinstance(node.func, ast.Name) else ""
    if name in SWAPPED:
        yield with_fields(node, func=ast.Name(SWAPPED[name], ast.Load()))
    if name in DROPPED:
        yield node.args[0]


def other_constant(value: object) -> Iterator[ast.AST]:
    if isinstance(value, bool):
        yield ast.Constant(not value)
    elif isinstance(value, int):
        yield ast.Constant(value + 1)
    elif isinstance(value, float):
        yield ast.Constant(2 * value if value else 1.0)


def alternatives(node: ast.AST) -> Iterator[ast.AST]:
    """What may stand in the place of a node."""
    match node:
        case ast.Compare():
            yield from compared(node)
        case ast.BinOp(op=op) if type(op) in ARITHMETIC:
            yield with_fields(node, op=ARITHMETIC[type(op)]())
        case ast.AugAssign(op=op):
            yield with_fields(node, op=ARITHMETIC[type(op)]())
            yield ast.Pass()
        case ast.BoolOp(op=op):
            yield with_fields(node, op=ast.Or() if isinstance(op, ast.And) else ast.And())
        case ast.UnaryOp(op=ast.USub() | ast.Not(), operand=operand):
            yield operand
        case ast.Constant(value=value):
            yield from other_constant(value)
        case ast.Call():
            yield from called(node)
        case ast.If(test=test) | ast.IfExp(test=test) if not isinstance(test, ast.Compare) or len(test.ops) > 1:
            yield with_fields(node, test=ast.UnaryOp(ast.Not(), test))
        case ast.Expr(value=ast.Call()) | ast.Break() | ast.Continue():
            yield ast.Pass()
        case ast.Assign(targets=[ast.Subscript() | ast.Attribute()]):
            yield ast.Pass()


def is_compiler_option(node: ast.AST) -> bool:
    """Whether the node only tells Numba how to compile, which nothing shows without the JIT."""
    return isinstance(node, ast.Assign) and ast.unparse(node.value).startswith(("njit(", "register_jitable("))


def places(node: ast.AST) -> Iterator[tuple[ast.AST, str, int | None, ast.AST]]:
    """All nodes below this one, as (parent, field, index in the field or None, node)."""
    for field, value in ast.iter_fields(node):
        if field in ("decorator_list", "annotation", "returns"):
            continue
        several = isinstance(value, list)
        for k, child in enumerate(value if several else [value]):
            if isinstance(child, ast.AST) and not is_compiler_option(child):
                yield node, field, k if several else None, child
                yield from places(child)


def put(parent: ast.AST, field: str, index: int | None, node: ast.AST) -> None:
    if index is None:
        setattr(parent, field, node)
    else:
        getattr(parent, field)[index] = node


def excerpt(node: ast.AST) -> str:
    """A node in one line; of a statement with a body only the head."""
    line = ast.unparse(node).splitlines()[0]
    return line if len(line) <= 80 else line[:77] + "..."


def mutants(module: str) -> Iterator[Mutant]:
    """All mutants of a module, from the top down."""
    tree = ast.parse((ROOT / "eip_scipy" / f"{module}.py").read_text())
    line = 0
    for parent, field, index, node in list(places(tree)):
        line = getattr(node, "lineno", line)
        for other in alternatives(node):
            put(parent, field, index, other)
            change = f"{excerpt(node)} -> {excerpt(other)}"
            yield Mutant(module, line, change, ast.unparse(ast.fix_missing_locations(tree)))
            put(parent, field, index, node)


def copy_package(folder: Path) -> None:
    """Lay the package and its tests out as if installed in the folder."""
    leave = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "eip_scipy", folder / "eip_scipy", ignore=leave)
    shutil.copytree(ROOT / "integrations", folder / "eip_scipy" / "integrations", ignore=leave)
    shutil.copytree(ROOT / "tests", folder / "tests", ignore=leave)
    shutil.copy(ROOT / "pyproject.toml", folder)


class Order:
    """A plugin: tests that have killed a mutant come first, the latest before the others; one that fails is noted."""

    def __init__(self, killers: list[str], note: Path) -> None:
        self.rank = {test: k for k, test in enumerate(reversed(killers))}
        self.note = note

    def pytest_collection_modifyitems(self, items: list) -> None:
        items.sort(key=lambda item: self.rank.get(item.nodeid, len(self.rank)))

    def pytest_runtest_logreport(self, report) -> None:
        if report.failed:
            self.note.write_text(report.nodeid)


def run_tests(folder: Path, killers: list[str], keep_bytecode: bool) -> None:
    """In the child: end with pytest's exit status."""
    import resource

    import pytest

    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    sys.dont_write_bytecode = not keep_bytecode
    os.chdir(folder)
    sys.path.insert(0, str(folder))
    with open(LOG, "w") as stream:
        os.dup2(stream.fileno(), 1)
        os.dup2(stream.fileno(), 2)
    files = [f"tests/{name}.py" for name in TESTS]
    options = ["-x", "-q", "--no-header", "--tb=no", "-p", "no:cacheprovider", "-m", MARKERS]
    sys.exit(pytest.main([*options, *files], [Order(killers, Path(KILLER))]))


def outcome(folder: Path, killers: list[str], limit: float | None, keep_bytecode: bool = False) -> tuple[str, float]:
    """Run the tests in a child: "survived", "killed" or "timeout", and the seconds taken."""
    context = multiprocessing.get_context("fork")
    child = context.Process(target=run_tests, args=(folder, killers, keep_bytecode))
    begin = time.perf_counter()
    child.start()
    child.join(limit)
    seconds = time.perf_counter() - begin
    if child.is_alive():
        child.kill()
        child.join()
        return "timeout", seconds
    return ("killed" if child.exitcode else "survived"), seconds


def place(mutant: dict) -> str:
    return f"{mutant['module']}.py:{mutant['line']}: {mutant['change']}"


def noted(file: Path) -> str:
    """The test that failed, if one did; the note is taken away."""
    test = file.read_text() if file.exists() else ""
    file.unlink(missing_ok=True)
    return test


def measure(chosen: list[Mutant]) -> list[dict]:
    """Try the mutants one by one, after a run without any."""
    from tqdm import tqdm

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        copy_package(folder)
        state, seconds = outcome(folder, [], None, keep_bytecode=True)
        if state != "survived":
            sys.exit(f"The tests fail without any mutation:\n{(folder / LOG).read_text()}")
        for module in MODULES:  # bytecode of the mutated modules could be taken for theirs
            shutil.rmtree((folder / "eip_scipy" / module).parent / "__pycache__", ignore_errors=True)
        print(f"Tests without a mutation: {seconds:.0f} s")
        results: list[dict] = []
        killers: dict[str, None] = {}
        for mutant in tqdm(chosen, unit="mutant"):
            file = folder / "eip_scipy" / f"{mutant.module}.py"
            whole = file.read_text()
            file.write_text(mutant.source)
            state, taken = outcome(folder, list(killers), 30.0 + 3.0 * seconds)
            file.write_text(whole)
            test = noted(folder / KILLER)
            if test:
                killers.pop(test, None)
                killers[test] = None
            if state == "survived":
                tqdm.write(place(mutant._asdict()))
            results.append({**mutant._asdict(), "outcome": state, "seconds": taken, "test": test})
        return results


def report(results: list[dict], total: dict[str, int]) -> str:
    """The score by module as a table in Markdown, and the survivors."""
    lines = ["| module | mutants | tried | killed | of these by time | survived | score |", "|---" * 7 + "|"]
    for module in (*total, "all"):
        tried = [r for r in results if module in (r["module"], "all")]
        survived = sum(r["outcome"] == "survived" for r in tried)
        timeouts = sum(r["outcome"] == "timeout" for r in tried)
        known = sum(total.values()) if module == "all" else total[module]
        score = f"{100 * (1 - survived / len(tried)):.0f} %" if tried else "-"
        lines.append(
            f"| {module} | {known} | {len(tried)} | {len(tried) - survived} | {timeouts} | {survived} | {score} |"
        )
    return "\n".join([*lines, "", "Survivors:", "", *(place(r) for r in results if r["outcome"] == "survived")])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=400, help="mutants to try, drawn at random; 0 for all")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--module", choices=MODULES, help="one module only")
    parser.add_argument("--json", metavar="FILE")
    arguments = parser.parse_args()
    os.environ["NUMBA_DISABLE_JIT"] = "1"
    for name in PRELOADED:
        importlib.import_module(name)
    modules = (arguments.module,) if arguments.module else MODULES
    known = [mutant for module in modules for mutant in mutants(module)]
    total = {module: sum(mutant.module == module for mutant in known) for module in modules}
    drawn = range(len(known))
    if 0 < arguments.count < len(known):
        drawn = sorted(random.Random(arguments.seed).sample(drawn, arguments.count))
    results = measure([known[k] for k in drawn])
    print(report(results, total))
    if arguments.json:
        Path(arguments.json).write_text(json.dumps([{**r, "source": None} for r in results], indent=1))


if __name__ == "__main__":
    main()
