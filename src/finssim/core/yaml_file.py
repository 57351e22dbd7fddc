"""Reader of untrusted YAML and JSON of bounded size, which reports errors in one sentence, and writer of YAML."""

import difflib
import json
import re
from collections.abc import Callable, Hashable, Sequence
from pathlib import Path
from typing import Any, cast, get_args

import yaml

from finssim.core.budget import read_bytes

LONGEST = 32 << 20
"""Largest size of a YAML file [bytes]."""
LARGEST = 200_000
"""Largest number of values in a YAML file, including those repeated by aliases."""
DEEPEST = 100
"""Largest nesting depth of lists and mappings."""


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """Loader of YAML 1.2 scalars (`1e-5` is a number, `on` is a string) that refuses repeated keys."""

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}
    yaml_constructors = {
        tag: yaml.SafeLoader.yaml_constructors[tag]
        for tag in (None, *(f"tag:yaml.org,2002:{kind}" for kind in ("str", "seq", "map", "null")))
    }

    def construct_scalar_of(self, node: yaml.Node) -> bool | int | float:
        """Return a number or Boolean; an explicit tag such as `!!int` may occur with any text."""
        kind, text = node.tag.rpartition(":")[2], node.value if isinstance(node, yaml.ScalarNode) else ""
        if self.resolve(yaml.ScalarNode, text, (True, False)) not in (node.tag, INTEGER):
            raise yaml.constructor.ConstructorError(
                None, None, f"'{text[:40]}' is no {kind}", node.start_mark
            )
        if kind == "bool":
            return str(text) == "true"
        return whole_number(text) if kind == "int" else float(re.sub(r"\.(?=[a-zA-Z])", "", text))

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        keys: set[Any] = set()
        for key_node, _ in node.value if isinstance(node, yaml.MappingNode) else ():
            key = self.construct_object(key_node, deep=True)
            problem = None
            if not isinstance(key, Hashable):
                problem = f"a key is a {type(key).__name__}, expected a word"
            elif key in keys:
                problem = f"key '{key}' is given twice"
            if problem:
                raise yaml.constructor.ConstructorError(None, None, problem, key_node.start_mark)
            keys.add(key)
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


class _Dumper(yaml.SafeDumper):
    """Dumper that also quotes strings that the reader would parse as numbers, such as the digest 12e34."""

    yaml_implicit_resolvers = {
        first: yaml.SafeDumper.yaml_implicit_resolvers.get(first, [])
        + _Loader.yaml_implicit_resolvers.get(first, [])
        for first in {*yaml.SafeDumper.yaml_implicit_resolvers, *_Loader.yaml_implicit_resolvers}
    }


def yaml_text(tree: Any, **options: Any) -> str:
    """Return plain data as YAML, with keys in their order, such that `read_mapping` restores the data.

    Args:
        tree: Dictionaries, lists, strings, numbers.
        options: Options of `yaml.dump`, such as width.
    """
    return str(yaml.dump(tree, Dumper=_Dumper, **{"sort_keys": False, "allow_unicode": True, **options}))


INTEGER = "tag:yaml.org,2002:int"
for _kind in ("bool", "int", "float"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_kind}", _Loader.construct_scalar_of)


def whole_number(text: str) -> int | float:
    """Return the value of an integer in text, in its own unit; a float if it exceeds 64 bits."""
    value = int(text) if len(text) < 30 else 2**64
    return value if -(2**63) <= value < 2**63 else float(text)


def _refuse_bombs(text: str) -> None:
    """Refuse YAML that is nested too deeply or too large, before anything is constructed from it.

    Raises:
        MarkedYAMLError: The text exceeds a limit, or a value contains itself.
    """
    sizes: dict[str, int] = {}
    opened: list[tuple[str | None, int]] = []
    count, problem = 0, None
    for event in yaml.parse(text, Loader=_Loader):
        if isinstance(event, yaml.AliasEvent):
            if event.anchor not in sizes:
                problem = f"alias '*{event.anchor}' refers to no anchor that is complete before it"
            count += sizes.get(str(event.anchor), 0)
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, begin = opened.pop()
            if anchor is not None:
                sizes[anchor] = count - begin
        elif isinstance(event, yaml.NodeEvent):
            sizes.pop(event.anchor or "", None)
            if isinstance(event, yaml.CollectionStartEvent):
                opened.append((event.anchor, count))
            elif event.anchor is not None:
                sizes[event.anchor] = 1
            count += 1
        if len(opened) > DEEPEST:
            problem = f"more than {DEEPEST} lists and mappings inside one another"
        if count > LARGEST:
            problem = f"more than {LARGEST} values, repeated ones included"
        if problem:
            raise yaml.MarkedYAMLError(problem=problem, problem_mark=cast(Any, event.start_mark))


def json_value(text: str | bytes, refuse: type[Exception], name: str) -> Any:
    """Return the value of a JSON text.

    Args:
        text: The JSON.
        refuse: Class of the error, constructed with one sentence.
        name: Name of the text in the sentence.

    Raises:
        refuse: The text is not JSON, or is nested too deeply.
    """
    try:
        value = json.loads(text, parse_int=whole_number)
        if _deeper(value, DEEPEST):
            raise RecursionError
    except RecursionError:
        raise refuse(f"{name}: more than {DEEPEST} lists and mappings inside one another") from None
    except ValueError as error:
        raise refuse(f"{name}: not valid JSON: {error}") from None
    return value


def _deeper(value: Any, depth: int) -> bool:
    """Return whether lists and mappings are nested more deeply than a limit."""
    if not isinstance(value, dict | list):
        return False
    return not depth or any(
        _deeper(v, depth - 1) for v in (value.values() if isinstance(value, dict) else value)
    )


def read_json(path: Path, refuse: type[Exception], *, such_as: str) -> dict[str, Any]:
    """Return the mapping in a JSON file.

    Args:
        path: The file.
        refuse: Class of the error, constructed with one sentence.
        such_as: A key that the file must contain, for the sentence.

    Raises:
        refuse: The file is missing or unreadable, is not JSON, or contains no mapping with that key.
    """
    tree = json_value(read_bytes(path, refuse), refuse, str(path))
    if not isinstance(tree, dict) or such_as not in tree:
        raise refuse(f"{path}: expected a JSON object with the key '{such_as}'")
    return tree


def read_mapping(
    path: Path,
    refuse: type[Exception],
    *,
    such_as: str,
    label: str | None = None,
    cleaned: Callable[[str], str] = str,
) -> dict[Any, Any]:
    """Return the mapping in a YAML file.

    Args:
        path: The file.
        refuse: Class of the error, constructed with one sentence.
        such_as: An example of an expected key, for the sentence.
        label: Name of the file in the sentence; its path if None.
        cleaned: Function that converts the text of a YAML dialect to standard YAML.

    Raises:
        refuse: The file is missing or unreadable, not text, malformed, or contains no mapping.
    """
    name = str(path) if label is None else label
    try:
        with path.open("rb") as file:
            data = file.read(LONGEST + 1)
        if len(data) > LONGEST:
            raise refuse(f"{name}: longer than {LONGEST >> 20} MiB, expected keys such as '{such_as}'")
        text = cleaned(data.decode("utf-8"))
        _refuse_bombs(text)
        tree = yaml.load(text, Loader=_Loader)
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
        names = {"NoneType": "nothing", "str": "plain text", "list": "a list"}
        actual = names.get(type(tree).__name__, f"the value {tree!r}")
        raise refuse(f"{name}: expected keys such as '{such_as}', found {actual}")
    return tree


def first_problem(error: Any, model: Any) -> str:
    """Return the first error that Pydantic found in data from a file, as `location: error`.

    Args:
        error: A `pydantic.ValidationError`.
        model: The Pydantic model of the data, whose keys are listed if one is unknown.
    """
    problem = error.errors()[0]
    # Names of alternatives, which begin with a bracket, are not part of the location.
    parts = [str(part) for part in problem["loc"] if not str(part).startswith("(")]
    location, message = ".".join(parts), str(problem["msg"]).removeprefix("Value error, ")
    kind, value = problem["type"], problem.get("input")
    if kind == "literal_error":
        message = f"is {value!r}, expected {problem['ctx']['expected']}"
    elif kind == "missing":
        message = "is missing: add it"
    elif kind in ("tuple_type", "list_type"):
        message = f"is {value!r}, expected a list of values"
    elif kind in ("extra_forbidden", "unexpected_keyword_argument"):
        known = _keys(model, parts[:-1])
        close = difflib.get_close_matches(parts[-1], known, n=1)
        message = f"unknown key, did you mean '{close[0]}'?" if close else "unknown key;"
        message = f"{message} known keys: {', '.join(known)}" if known else "unknown key: remove it"
    elif kind != "value_error" and isinstance(value, str | float | int | None):
        message = f"{message}, found {value!r}"
    return f"{location}: {message}" if location else message


def _keys(model: Any, path: Sequence[str]) -> list[str]:
    """Return the keys of the model or dataclass at a path, also in lists and optional sections; none if unclear."""
    for step in path:
        if not step.isdigit():
            fields = getattr(model, "model_fields", None) or getattr(model, "__dataclass_fields__", {})
            field = fields.get(step)
            model = getattr(field, "annotation", None) or getattr(field, "type", None)
        while inner := [part for part in get_args(model) if part not in (type(None), Ellipsis)]:
            model = inner[0]
    return list(getattr(model, "model_fields", None) or getattr(model, "__dataclass_fields__", {}))
