"""The one reader of YAML files written by hand: a mapping, or one sentence that says what is wrong with the file."""

import re
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Any

import yaml


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """YAML 1.2 scalars (`1e-5` is a number, `on` is a word) and no silently repeated keys."""

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen: set[Any] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            problem = None
            if not isinstance(key, Hashable):
                problem = f"key {key} is a {type(key).__name__}, expected a word"
            elif key in seen:
                problem = f"key '{key}' is given twice"
            if problem:
                raise yaml.constructor.ConstructorError(None, None, problem, key_node.start_mark)
            seen.add(key)
        return super().construct_mapping(node, deep)  # type: ignore[no-any-return]


_Loader.add_implicit_resolver("tag:yaml.org,2002:null", re.compile(r"^(?:~|null|)$"), ["~", "n", ""])
_Loader.add_implicit_resolver("tag:yaml.org,2002:bool", re.compile(r"^(?:true|false)$"), list("tf"))
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:int", re.compile(r"^[-+]?(?:0|[1-9][0-9]*)$"), list("-+0123456789")
)
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(
        r"^(?:[-+]?(?:\.[0-9]+|[0-9]+\.?[0-9]*)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"
    ),
    list("-+0123456789."),
)


def read_mapping(
    path: Path,
    refuse: type[Exception],
    *,
    such_as: str,
    shown: str | None = None,
    cleaned: Callable[[str], str] = str,
) -> dict[Any, Any]:
    """The mapping that a YAML file holds.

    Args:
        path: The file.
        refuse: Class of the error, made from one sentence.
        such_as: An example of what the file should hold, for that sentence.
        shown: How the sentence calls the file; its path where not given.
        cleaned: Makes standard YAML of the text of a dialect.

    Raises:
        refuse: The file is missing or unreadable, not text, malformed, or holds no mapping.
    """
    name = str(path) if shown is None else shown
    try:
        tree = yaml.load(cleaned(path.read_text(encoding="utf-8")), Loader=_Loader)
    except OSError as error:
        raise refuse(f"{name}: cannot be read: {error.strerror or error}") from None
    except (UnicodeDecodeError, yaml.reader.ReaderError):
        raise refuse(f"{name}: is not a text file in UTF-8: give a YAML file") from None
    except yaml.MarkedYAMLError as error:
        line = f" line {error.problem_mark.line + 1}:" if error.problem_mark else ""
        raise refuse(f"{name}:{line} not valid YAML: {error.problem}: correct that line") from None
    except yaml.YAMLError as error:
        raise refuse(f"{name}: not valid YAML: {' '.join(str(error).split())}") from None
    if not isinstance(tree, dict):
        found = "nothing" if tree is None else f"a {type(tree).__name__}"
        raise refuse(f"{name}: expected keys such as '{such_as}', found {found}")
    return tree


def first_problem(error: Any) -> str:
    """What Pydantic found wrong first in data from a file, as `where: what`.

    Args:
        error: A `pydantic.ValidationError`.
    """
    problem = error.errors()[0]
    where, what = ".".join(map(str, problem["loc"])), str(problem["msg"]).removeprefix("Value error, ")
    return f"{where}: {what}" if where else what
