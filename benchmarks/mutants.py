"""Mutation test: do the tests notice a wrong sign, bound or condition? Changes the source in 80 places, one at a time.

    python benchmarks/mutants.py [--count 80] [--seed 2] [--packages a,b] [--out FILE] [--checkout FOLDER] [--list]

A place is a sum, difference, product, comparison, boolean operator or number in a function of `src/finssim`, drawn in
turn from the packages. It is changed in a copy of the package, on which the tests of the same name run and, if these
pass, those of the same folder (`physics/damping.py`: `tests/physics/test_damping.py`, then the quick tests of
`tests/physics`, then its slow ones). A function that no test calls is not counted: another place is drawn.
`--checkout` uses the tests of another revision, to compare the two on the same changes. Results are appended to
`--out`, and a run with the same seed continues after those in the file; `--again` tests its survivors once more.
"""

from __future__ import annotations

import argparse
import ast
import itertools
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src" / "finssim"
PACKAGES = "physics,control,localization,identification,learning,robot"
"""Packages in which places are drawn, in turn."""
SWAPS: dict[type[ast.AST], tuple[str, str]] = {
    ast.Add: ("+", "-"),
    ast.Sub: ("-", "+"),
    ast.Mult: ("*", "/"),
    ast.Lt: ("<", ">="),
    ast.LtE: ("<=", ">"),
    ast.Gt: (">", "<="),
    ast.GtE: (">=", "<"),
    ast.Eq: ("==", "!="),
    ast.NotEq: ("!=", "=="),
    ast.And: ("and", "or"),
    ast.Or: ("or", "and"),
}
LONGEST = 1800
"""Longest run of tests, after which they count as failed [s]."""
LONGEST_TEST = 300
"""Longest single test, after which it counts as failed [s]."""


@dataclass(frozen=True)
class Mutant:
    """Mutant: file below `src/finssim`, line and column of the replaced text."""

    path: str
    line: int
    column: int
    before: str
    after: str


def mutants(path: Path) -> Iterator[Mutant]:
    """Yield every mutant of a file's functions; docstrings, annotations and messages are not changed."""
    lines = path.read_text(encoding="utf-8").splitlines()
    name = path.relative_to(SOURCE).as_posix()
    tree = ast.parse("\n".join(lines))
    functions = [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)]
    seen: set[tuple[int, int]] = set()
    for node in (n for f in functions for statement in f.body for n in ast.walk(statement)):
        if isinstance(node, ast.BinOp):
            pairs = [(node.left, node.op, node.right)]
        elif isinstance(node, ast.Compare):
            pairs = list(zip([node.left, *node.comparators], node.ops, node.comparators, strict=False))
        elif isinstance(node, ast.BoolOp):
            pairs = [(a, node.op, b) for a, b in zip(node.values, node.values[1:], strict=False)]
        elif isinstance(node, ast.Constant) and type(node.value) in (int, float) and node.value not in (0, 1):
            text = ast.get_source_segment("\n".join(lines), node) or ""
            place = (node.lineno, len(lines[node.lineno - 1].encode()[: node.col_offset].decode()))
            if place not in seen and lines[place[0] - 1][place[1] :].startswith(text):
                seen.add(place)
                yield Mutant(
                    name,
                    *place,
                    text,
                    f"(1.25 * {text})" if isinstance(node.value, float) else f"({text} + 1)",
                )
            continue
        else:
            continue
        for left, op, right in pairs:
            swap = SWAPS.get(type(op))
            if swap is None or left.end_lineno != right.lineno or is_text(left) or is_text(right):
                continue
            line = lines[left.end_lineno - 1].encode()
            between = line[left.end_col_offset : right.col_offset].decode()
            if between.strip(" ()") != swap[0]:
                continue
            column = len(line[: left.end_col_offset].decode()) + between.index(swap[0])
            if (left.end_lineno, column) not in seen:
                seen.add((left.end_lineno, column))
                yield Mutant(name, left.end_lineno, column, *swap)


def is_text(node: ast.AST) -> bool:
    """Return True for a string, whose sums and products are not arithmetic."""
    return isinstance(node, ast.JoinedStr) or (isinstance(node, ast.Constant) and isinstance(node.value, str))


def drawn(seed: int, packages: list[str]) -> Iterator[Mutant]:
    """Yield mutants in turn from every package."""
    rng = random.Random(seed)
    pools = {}
    for package in packages:
        pools[package] = [m for path in sorted((SOURCE / package).rglob("*.py")) for m in mutants(path)]
        rng.shuffle(pools[package])
    while any(pools.values()):
        for package in packages:
            if pools[package]:
                yield pools[package].pop()


def tests_of(path: str, checkout: Path) -> list[tuple[str, ...]]:
    """Return the tests of a module: those of its name if there are any, then those of its folder or the
    nearest one above."""
    folder = (checkout / "tests" / path).parent
    while not folder.is_dir():
        folder = folder.parent
    named = sorted(folder.rglob(f"test_{Path(path).stem}.py"))
    tests = [(file.relative_to(checkout).as_posix(),) for file in named]
    whole = folder.relative_to(checkout).as_posix()
    return [*tests, (whole, "-m", "not slow"), (whole, "-m", "slow")]


class Copy:
    """Copy of the package that is changed, tested and restored."""

    def __init__(self, folder: Path, checkout: Path) -> None:
        self.source, self.kernels, self.checkout = folder / "src", folder / "kernels", checkout
        self.sound: dict[tuple[str, ...], bool] = {}
        shutil.copytree(SOURCE, self.source / "finssim", ignore=shutil.ignore_patterns("__pycache__"))

    def failing(self, mutant: Mutant, text: str) -> tuple[str, ...] | None:
        """Return the tests that fail with another text of a file, of those that pass on the original."""
        file = self.source / "finssim" / mutant.path
        original = file.read_text(encoding="utf-8")
        for tests in tests_of(mutant.path, self.checkout):
            if tests not in self.sound:
                self.sound[tests] = self._passes(tests)
            if not self.sound[tests]:
                continue
            file.write_text(text, encoding="utf-8")
            passed = self._passes(tests)
            file.write_text(original, encoding="utf-8")
            if not passed:
                return tests
        return None

    def _passes(self, tests: tuple[str, ...]) -> bool:
        environment = os.environ | {
            "PYTHONPATH": str(self.source),
            "PYTHONDONTWRITEBYTECODE": "1",  # a change within the same second would be taken for the original
            "WARP_CACHE_PATH": str(self.kernels),
        }
        words = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider"]
        words += [f"--timeout={LONGEST_TEST}", *tests]
        try:
            done = subprocess.run(
                words, cwd=self.checkout, env=environment, capture_output=True, timeout=LONGEST, check=False
            )
        except subprocess.TimeoutExpired:
            return False
        return done.returncode in (0, 5)  # 5: no tests


def changed(mutant: Mutant) -> str:
    """Return the file's text with the change."""
    lines = (SOURCE / mutant.path).read_text(encoding="utf-8").splitlines(keepends=True)
    line = lines[mutant.line - 1]
    before, after = line[: mutant.column], line[mutant.column + len(mutant.before) :]
    lines[mutant.line - 1] = before + mutant.after + after
    return "".join(lines)


def refusing(mutant: Mutant) -> str:
    """Return the file's text with an error at the beginning of the function that contains the change."""
    text = (SOURCE / mutant.path).read_text(encoding="utf-8")
    holders = [
        n
        for n in ast.walk(ast.parse(text))
        if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)
        and n.lineno <= mutant.line <= (n.end_lineno or 0)
    ]
    first = max(holders, key=lambda n: n.lineno).body[0]
    lines = text.splitlines(keepends=True)
    lines.insert(first.lineno - 1, " " * first.col_offset + 'raise RuntimeError("called")\n')
    return "".join(lines)


def main() -> None:
    """Print each mutant with its result, and the totals."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--count", type=int, default=80)
    parser.add_argument("--seed", type=int, default=2)
    parser.add_argument("--packages", default=PACKAGES)
    parser.add_argument("--out", type=Path, help="JSON lines of results, continued where it exists")
    parser.add_argument("--again", action="store_true", help="test the survivors in --out again")
    parser.add_argument("--checkout", type=Path, default=ROOT, help="where the tests are")
    parser.add_argument("--list", action="store_true", help="only print the places")
    given = parser.parse_args()
    packages = given.packages.split(",")
    if given.list:
        for mutant in itertools.islice(drawn(given.seed, packages), given.count):
            print(name_of(mutant))
        return
    before: dict[str, Any] = {}
    if given.out is not None and given.out.exists():
        rows = [json.loads(line) for line in given.out.read_text(encoding="utf-8").splitlines()]
        before = {row["change"]: row for row in rows}
    counted = caught = 0
    with tempfile.TemporaryDirectory() as folder:
        copy = Copy(Path(folder), given.checkout.resolve())
        for mutant in drawn(given.seed, packages):
            if counted == given.count:
                break
            row = before.get(name_of(mutant))
            if row is None or (given.again and row["result"] == "survived"):
                row = {"change": name_of(mutant), **tried(copy, mutant)}
                if given.out is not None:
                    with given.out.open("a", encoding="utf-8") as file:
                        file.write(json.dumps(row) + "\n")
            print(f"{row['result']:10} {row['change']} {row['by']}", flush=True)
            counted += row["result"] != "not called"
            caught += row["result"] == "caught"
    print(f"{caught} of {counted} caught")


def name_of(mutant: Mutant) -> str:
    """Return position, kind and line of a mutant."""
    line = (SOURCE / mutant.path).read_text(encoding="utf-8").splitlines()[mutant.line - 1].strip()
    return f"{mutant.path}:{mutant.line}: {mutant.before} -> {mutant.after} in `{line}`"


def tried(copy: Copy, mutant: Mutant) -> dict[str, str]:
    """Test a mutant: caught, survived or not called, and the tests that caught it."""
    tests = copy.failing(mutant, changed(mutant))
    if tests is not None:
        return {"result": "caught", "by": " ".join(tests)}
    called = copy.failing(mutant, refusing(mutant)) is not None
    return {"result": "survived" if called else "not called", "by": ""}


if __name__ == "__main__":
    main()
