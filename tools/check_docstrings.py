"""Do public functions say in which unit, frame and shape they take and give physical quantities?

    python tools/check_docstrings.py    what is missing; exit status 1 where there is any

A parameter is physical by its name (`QUANTITIES`) and its type: a number or an array. Its entry under `Args:`, or the
docstring's other text where it names none, must hold a unit in brackets, such as [m/s] or [-] for none; of an array
a shape, such as (n, 3); and of a quantity with a direction a frame.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

DIRECTED = set(
    "position velocity acceleration force moment torque wrench tau nu twist omega quaternion normal gravity current "
    "displacement momentum direction attitude".split()
)
"""Names of quantities that have a direction: their frame must be said."""
QUANTITIES = DIRECTED | set(
    "time duration speed depth height length width radius diameter angle yaw roll pitch tilt heading mass inertia "
    "density volume area thrust voltage pressure temperature rate frequency period latency delay distance stiffness "
    "damping power energy rpm pulse".split()
)
ARRAYS = re.compile(r"\b(Array|NDArray|ndarray|ArrayLike|Tensor|array)\b")
NUMBERS = re.compile(r"\b(float|vec\d*|quat|mat\d*)\b")
VECTORS = re.compile(r"\b(vec\d*|quat|mat\d*)\b")
UNIT = re.compile(r"\[[^\]\n]*\]")
SHAPE = re.compile(r"\((?:[A-Za-z0-9_.+* -]+,)+[A-Za-z0-9_.+* ,-]*\)")
FRAME = re.compile(r"\b(frame|axes|body|world|pool|camera|optical|map|reference)\b", re.IGNORECASE)


def functions(tree: ast.Module) -> Iterator[tuple[str, ast.FunctionDef]]:
    """Public functions of a module, and public methods of its public classes, by name."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            yield node.name, node
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            for own in node.body:
                if isinstance(own, ast.FunctionDef) and not own.name.startswith("_"):
                    yield f"{node.name}.{own.name}", own


def missing(function: ast.FunctionDef) -> list[str]:
    """What its docstring does not say of its physical parameters."""
    text = ast.get_docstring(function) or ""
    out = []
    for parameter in [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]:
        kind = ast.unparse(parameter.annotation) if parameter.annotation else ""
        words = set(parameter.arg.lower().split("_"))
        array = bool(ARRAYS.search(kind))
        if not words & QUANTITIES or not (array or NUMBERS.search(kind)) or "Callable" in kind:
            continue
        entry = re.search(
            rf"^ *{re.escape(parameter.arg)}( \([^)]*\))?: (.*(?:\n {{8,}}.*)*)", text, re.MULTILINE
        )
        own = entry.group(2) if entry else text
        if not UNIT.search(own) and "quaternion" not in words:
            out.append(f"{parameter.arg}: unit")
        if array and not SHAPE.search(own):
            out.append(f"{parameter.arg}: shape")
        if words & DIRECTED and (array or VECTORS.search(kind)) and not FRAME.search(text):
            out.append(f"{parameter.arg}: frame")
    return out


def found() -> dict[str, list[str]]:
    """What is missing, by function."""
    out = {}
    files = [(path, ROOT / "src") for path in sorted((ROOT / "src").rglob("*.py"))]
    for path, source in [*files, *((path, ROOT) for path in sorted((ROOT / "studies").rglob("*.py")))]:
        if path.name.startswith("_") and path.name != "__init__.py":
            continue
        module = ".".join(path.relative_to(source).with_suffix("").parts).removesuffix(".__init__")
        for name, function in functions(ast.parse(path.read_text(encoding="utf-8"))):
            if missing(function):
                out[f"{module}:{name}"] = missing(function)
    return out


def main() -> int:
    """Exit status 1 where something is missing."""
    lacking = found()
    for name, what in lacking.items():
        print(f"{name}: its docstring does not say: {', '.join(what)}")
    return int(bool(lacking))


if __name__ == "__main__":
    sys.exit(main())
