"""The sentences written under a dataclass' fields: Python does not keep them, their source does."""

from __future__ import annotations

import ast
import inspect
import textwrap

__all__ = ["attribute_docs"]


def attribute_docs(kind: type) -> dict[str, str]:
    """Field -> the string that follows it, of a class and those it is derived from; where the source can be had."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__[:-1]):
        try:
            (tree,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        except (OSError, TypeError, SyntaxError):
            continue
        body = tree.body if isinstance(tree, ast.ClassDef) else []
        for line, after in zip(body, body[1:], strict=False):
            told = after.value if isinstance(after, ast.Expr) else None
            if (
                isinstance(line, ast.AnnAssign)
                and isinstance(line.target, ast.Name)
                and isinstance(told, ast.Constant)
            ):
                found[line.target.id] = " ".join(str(told.value).split())
    return found
