"""Check that public docstrings state unit, shape and frame of the numbers that functions take, return and store.

    python tools/check_docstrings.py    lists what is missing; exit status 1 if anything is

A parameter, a return value or a field is judged by its annotated type. A real number, or an array of real numbers,
needs a unit in brackets, such as [m/s], or a name without unit, such as a share; or the text refers to the documented
function or class whose numbers they are. Quaternions have none by their type. An array parameter needs a shape, such
as (n, 3), and a quantity with a direction a frame. The checked text is the entry under `Args:` or `Returns:`, the
docstring or comment of the field, and if there is none the docstring of the function or class. Integers are counts,
indices and seeds.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

DIRECTED = set(
    "position velocity acceleration force moment torque wrench tau nu twist omega quaternion normal gravity current "
    "displacement momentum direction attitude".split()
)
"""Names of quantities that have a direction: their frame must be stated."""
QUANTITIES = DIRECTED | set(
    "time duration speed depth height length width radius diameter angle yaw roll pitch tilt heading mass inertia "
    "density volume area thrust voltage pressure temperature rate frequency period latency delay distance stiffness "
    "damping power energy rpm pulse".split()
)
"""Names of quantities whose shape must be stated where they are arrays."""
NAMED = {"quaternion", "orientation", "rotation", "pixel", "pixels", "mask"}
"""Names that imply a unit, or that there is none."""
REAL = re.compile(r"float(16|32|64)?|floating|(vec|mat)\d*[df]?|transform")
VECTORS = re.compile(r"(vec|mat|quat)\d*[df]?")
ARRAYS = {"NDArray", "ndarray", "ArrayLike", "Tensor", "array", "array2d", "array3d", "array4d"}
SEVERAL = set("Mapping Sequence Iterable Iterator tuple list dict str Any Annotated Optional".split())
"""Container types that do not determine the type of the numbers in them."""
UNIT = re.compile(
    r"\[[^\]\n]*\]|\bunits?\b|\bpixels?\b|\bin (metres|seconds|radians|degrees)\b", re.IGNORECASE
)
PURE = re.compile(
    r"\b(dimensionless|shares?|chances?|part of|fraction|ratio|probabilit\w+|likelihoods?|factors?|weights?|scales?|"
    r"quaternions?|scores?|per cent|rewards?|rotation matri(x|ces)|co?sines?|correlations?|quantiles?|logarithms?|"
    r"numbers? of|counts?|index|indices|seeds?|faces|attitudes?|standard normal|observations?|actions?|pictures?|"
    r"colours?|grey|gray|contrast|reflectances?|confidence|exponent|learning rate|gradients?|logits?|features?)\b",
    re.IGNORECASE,
)
REFERENCE = re.compile(r"\b(as|see)\b[^.;\n]*`", re.IGNORECASE)
SHAPE = re.compile(r"\((?:[A-Za-z0-9_.+* -]+,)+[A-Za-z0-9_.+* ,-]*\)")
FRAME = re.compile(r"\b(frame|axes|body|world|pool|camera|optical|map|reference)\b", re.IGNORECASE)


@cache
def source_of(module: str) -> str | None:
    """Return the source of a module of the package or the studies; None where there is no such file."""
    path = ROOT / ("src" if module.partition(".")[0] == "finssim" else "") / module.replace(".", "/")
    for file in (path.with_suffix(".py"), path / "__init__.py"):
        if file.is_file():
            return file.read_text(encoding="utf-8")
    return None


@cache
def tree_of(module: str) -> ast.Module | None:
    """Return the syntax tree of a module of the package or the studies; None where there is no such file."""
    source = source_of(module)
    return None if source is None else ast.parse(source)


@cache
def definitions(module: str) -> dict[str, ast.expr | tuple[str, str]]:
    """Return name -> expression that a module assigns, or module and name that it imports."""
    tree = tree_of(module)
    known: dict[str, ast.expr | tuple[str, str]] = {}
    for node in [] if tree is None else ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            known |= {alias.asname or alias.name: (node.module, alias.name) for alias in node.names}
    for node in [] if tree is None else tree.body:
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Subscript | ast.BinOp | ast.Name):
            known[ast.unparse(node.targets[0])] = node.value
    return known


def definition(module: str, name: str) -> tuple[str, ast.expr] | None:
    """Return the module and the expression of a type's other name, such as `Array`; None where it has none."""
    known = definitions(module).get(name)
    if isinstance(known, tuple):
        return definition(*known) if known != (module, name) else None
    return None if known is None else (module, known)


def types(module: str, node: ast.expr | None) -> set[str]:
    """Return the names in an annotation, those of types that have another name resolved."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return types(module, ast.parse(node.value, mode="eval").body)
    if isinstance(node, ast.Name):
        known = definition(module, node.id)
        return {node.id} if known is None else types(*known)
    if isinstance(node, ast.Attribute):
        return {node.attr}
    if isinstance(node, ast.Call):  # wp.array(dtype=wp.vec3)
        return types(module, node.func).union(*(types(module, word.value) for word in node.keywords))
    if isinstance(node, ast.Subscript):
        head = types(module, node.value)
        if head & {"Literal", "Callable", "ClassVar", "type"}:
            return set()
        inner = (
            node.slice.elts[0] if "Annotated" in head and isinstance(node.slice, ast.Tuple) else node.slice
        )
        return head | types(module, inner)
    if isinstance(node, ast.Tuple | ast.List):
        return set().union(*(types(module, part) for part in node.elts))
    if isinstance(node, ast.BinOp):
        return types(module, node.left) | types(module, node.right)
    return set()


def is_real(names: set[str]) -> bool:
    """Return whether a type is, or contains, a real number or an array of them."""
    return any(REAL.fullmatch(name) for name in names) or (bool(names & ARRAYS) and names <= ARRAYS | SEVERAL)


def has_unit(text: str) -> bool:
    """Return whether a text states a unit, or that there is none."""
    return bool(UNIT.search(text) or PURE.search(text) or REFERENCE.search(text))


def entry(text: str, name: str) -> str | None:
    """Return the text of an argument in a docstring; None where it has no entry."""
    found = re.search(rf"^( *){re.escape(name)}(?: \([^)]*\))?: (.*(?:\n\1 +.*)*)", text, re.MULTILINE)
    return found and found.group(2)


def missing(function: ast.FunctionDef, module: str = "", about: str = "") -> Iterator[str]:
    """Yield the properties that the docstring of a function does not state.

    Args:
        function: The function.
        module: Module whose names its annotations use.
        about: Docstring of the class, of a constructor.
    """
    text = f"{ast.get_docstring(function) or ''}\n{about}"
    for parameter in [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]:
        names = types(module, parameter.annotation)
        words = set(parameter.arg.lower().split("_"))
        if not is_real(names):
            continue
        own = entry(text, parameter.arg) or text
        if not has_unit(own) and not words & NAMED:
            yield f"{parameter.arg}: unit"
        if names & ARRAYS and words & QUANTITIES and not SHAPE.search(own):
            yield f"{parameter.arg}: shape"
        vector = names & ARRAYS or any(VECTORS.fullmatch(name) for name in names)
        if vector and words & DIRECTED and not FRAME.search(text):
            yield f"{parameter.arg}: frame"
    if is_real(types(module, function.returns)):
        section = re.search(r"^ *(?:Returns|Yields):\n(.*?)(?:\n\n|\Z)", text, re.MULTILINE | re.DOTALL)
        if not has_unit(section.group(1) if section else text.partition("Args:\n")[0]):
            yield "what it returns: unit"


def missing_of_fields(kind: ast.ClassDef, module: str = "") -> Iterator[str]:
    """Yield the fields of a class whose numbers have no unit."""
    about = ast.get_docstring(kind) or ""
    lines = (source_of(module) or "").splitlines()
    for node, after in zip(kind.body, [*kind.body[1:], None], strict=True):
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            name = node.target.id
            comment = lines[node.end_lineno - 1].partition("  # ")[2] if lines and node.end_lineno else ""
            own = (
                ast.unparse(after.value)
                if isinstance(after, ast.Expr)
                else comment or entry(about, name) or about
            )
            real = is_real(types(module, node.annotation)) and not NAMED & set(name.lower().split("_"))
            if not name.startswith("_") and real and not has_unit(own):
                yield f"{name}: unit"


def lacking(tree: ast.Module, module: str) -> Iterator[tuple[str, list[str]]]:
    """Yield the missing properties of each public function, class and method of a module."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            yield node.name, list(missing(node, module))
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield node.name, list(missing_of_fields(node, module))
            for own in node.body:
                if isinstance(own, ast.FunctionDef) and "setter" in "".join(
                    map(ast.unparse, own.decorator_list)
                ):
                    continue  # the docstring belongs to its property
                made = isinstance(own, ast.FunctionDef) and own.name == "__init__"
                if isinstance(own, ast.FunctionDef) and (made or not own.name.startswith("_")):
                    about = ast.get_docstring(node) or "" if made else ""
                    yield f"{node.name}.{own.name}", list(missing(own, module, about))


def found() -> dict[str, list[str]]:
    """Return the missing properties, by function or class."""
    out = {}
    files = [(path, ROOT / "src") for path in sorted((ROOT / "src").rglob("*.py"))]
    for path, source in [*files, *((path, ROOT) for path in sorted((ROOT / "studies").rglob("*.py")))]:
        if path.name.startswith("_") and path.name != "__init__.py":
            continue
        module = ".".join(path.relative_to(source).with_suffix("").parts).removesuffix(".__init__")
        tree = tree_of(module)
        assert tree is not None
        for name, what in lacking(tree, module):
            if what:
                out[f"{module}:{name}"] = what
    return out


def main() -> int:
    """Return exit status 1 if anything is missing."""
    lacks = found()
    for name, what in lacks.items():
        print(f"{name}: its docstring does not state: {', '.join(what)}")
    return int(bool(lacks))


if __name__ == "__main__":
    sys.exit(main())
