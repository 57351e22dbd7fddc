"""Commands from Python functions: the signature defines the options, the docstring their help.

There is no other list. A function is read from its source, without being imported, so that help and refusals are
immediate:

    def simulate(*, duration: Annotated[float, (0.0, None)], out: Path, device: str = "cpu") -> None:
        \"\"\"Simulate a vehicle from rest.

        Example: finssim simulate --duration 10 --out run.csv

        Args:
            duration: Simulated time [s].
            out (FILE): Table to write.
            device (DEVICE): Compute device: cpu or cuda.
        \"\"\"

Parameters before `*` are positional, the others are options `--name`; a bool is a flag, a `Sequence` may be given
several times. A directory `out (DIR)` is written by one command at a time. `Annotated` adds bounds as `(low, high)`,
another name `"--name"`, or `","` for several values in one option. A parameter that is no text, number, flag or path,
or is annotated "python", is not an option and keeps its default, except the types in `MAKERS` and dataclasses
annotated "options", whose fields become options. `**options` with the help "As of `module.function`, without rows,
robot." stands for the options of that function except the named ones. The return value is the exit status, or a
result, whose `ok` gives status 0 or 3. In a module that defines `tables_of`, every function returns a result, which
`tables_of` converts to tables.
"""

from __future__ import annotations

import ast
import gc
import inspect
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
import typer.core

from finssim.cli import boundary
from finssim.core.files import sole_writer
from finssim.core.registry import COMMANDS, Family, RegistryError
from finssim.core.system import replace_unwritable

ROOT = Path(__file__).parents[2]
KINDS: Mapping[str, Any] = {
    "str": str, "int": int, "float": float, "bool": bool, "Path": Path, "Literal": str, "Severity": str, "Format": str
}  # fmt: skip
"""Name of an annotation -> type to which an argument is converted."""
MAKERS = {"OnRobot": "finssim.evaluation.robot_trials:robot_or_none"}
"""Name of an annotation -> function that creates its value, whose options replace the parameter."""
SEEDS = (0, 2**31 - 1)
LARGEST = 1e9
"""Greatest magnitude of a number on the command line, in any unit."""
CONTEXT: dict[str, Any] = {"help_option_names": ["-h", "--help"], "max_content_width": 110}
SETTINGS: dict[str, Any] = {"rich_markup_mode": None, "add_completion": False}
WRITTEN = ("out",)
"""Options whose directories are written."""
JSON = "Print one JSON object instead of tables."


@dataclass(frozen=True)
class Option:
    """Option of a command, made from a parameter of a function."""

    name: str
    kind: Any
    many: bool
    """True if the option may be repeated."""
    positional: bool
    default: Any
    """Default value; `inspect.Parameter.empty` if the option is required."""
    notes: tuple[Any, ...]
    """Notes of `Annotated`: bounds, names, or ","."""
    metavar: str | None
    help: str

    def parameter(self) -> inspect.Parameter:
        """Return the option as a parameter for Typer."""
        low, high = next((n for n in self.notes if isinstance(n, tuple)), (None, None))
        if self.name == "seed" and self.kind is int:
            low, high = SEEDS
        kind, default = (list[self.kind] if self.many else self.kind), self.default  # type: ignore[name-defined]
        if isinstance(default, tuple) and not self.many:
            default = ",".join(default)
        if default is None or (self.many and default is not inspect.Parameter.empty):
            kind, default = kind | None, None
        about: dict[str, Any] = {"help": self.help, "metavar": self.metavar, "min": low, "max": high}
        named = [n for n in self.notes if isinstance(n, str) and n.startswith("--")]
        if (self.positional and not named) or "argument" in self.notes:
            info: Any = typer.Argument(**about)
        else:
            flag = "--json" if self.name == "as_json" else f"--{self.name.replace('_', '-')}"
            info = typer.Option(*(named or [flag]), **about)
        kind_of_parameter = inspect.Parameter.KEYWORD_ONLY
        return inspect.Parameter(
            self.name, kind_of_parameter, default=default, annotation=Annotated[kind, info]
        )

    def value(self, typed: Any) -> Any:
        """Return the value with which the function is called.

        Raises:
            BadParameter: A number without bounds is not finite or too large.
        """
        if typed is None:
            return self.default
        if isinstance(typed, float) and not abs(typed) <= LARGEST:
            expected = f"{typed:g} is not a number from {-LARGEST:g} to {LARGEST:g}."
            raise typer.BadParameter(expected, param_hint=f"'--{self.name.replace('_', '-')}'")
        return tuple(word.strip() for word in typed.split(",")) if "," in self.notes else typed


@dataclass(frozen=True)
class Definition:
    """Definition of a function, read from its source."""

    path: str
    help: str
    arguments: Mapping[str, Option | Definition]
    """Parameter -> its option, or the function that creates its value from options, in the order of the signature."""
    positional: bool
    """True if its value is positional."""
    extra: bool
    """True if it accepts further arguments, as `*words`."""
    tabled: bool
    """True if it returns a result that the module's `tables_of` converts to tables."""

    def all_options(self) -> Iterator[Option]:
        """Yield all options, including those of the makers, in the order of the help."""
        for argument in self.arguments.values():
            yield from argument.all_options() if isinstance(argument, Definition) else [argument]

    def values(self, typed: Mapping[str, Any]) -> dict[str, Any]:
        """Return the arguments of the call by parameter, from the parsed command line."""
        return {
            name: argument.call(typed) if isinstance(argument, Definition) else argument.value(typed[name])
            for name, argument in self.arguments.items()
        }

    def call(self, typed: Mapping[str, Any], *extra: str) -> Any:
        """Call the function with the parsed command line."""
        values = self.values(typed)
        positional = [values.pop(name) for name, argument in self.arguments.items() if argument.positional]
        return loaded(self.path)(*positional, *extra, **values)


def loaded(path: str) -> Callable[..., Any]:
    """Import and return a function; Warp starts silently if its module needs it."""
    module, _, name = path.partition(":")
    function: Callable[..., Any] = getattr(import_module(module), name)
    if not gc.isenabled():  # `main` disabled it until the imports are done
        gc.freeze()
        gc.enable()
    if "warp" in sys.modules:
        from finssim.core.quiet import start_warp

        start_warp()
    return function


def _source(module: str) -> str:
    """Return the source of a module; one that is outside this package, such as `__main__`, is imported."""
    file = ROOT / (module.replace(".", "/") + ".py")
    if not file.is_file():
        file = Path(str(import_module(module).__file__))
    return file.read_text(encoding="utf-8")


def _origin(name: str, module: str, source: str) -> str:
    """Return the module that defines a class used in a module's source: itself, or one from which it is imported."""
    imported = rf"^from ([\w.]+) import (?:\([^)]*|[^(\n]*)\b{name}\b"
    match = re.search(imported, source, re.MULTILINE)
    return module if match is None else match[1]


def about(path: str) -> str:
    """Return the docstring of the module of module:function, the help of a group of commands."""
    return ast.get_docstring(ast.parse(_source(path.partition(":")[0]))) or ""


@cache
def read(path: str, positional: bool = False) -> Definition:
    """Read a function, or a dataclass of settings, from its source.

    Args:
        path: The function or class, module:name.
        positional: True if the created value is positional.
    """
    module, _, name = path.partition(":")
    source = _source(module)
    start = re.search(rf"^(def {name}\(|class {name}[(:])", source, re.MULTILINE)
    if start is None:
        raise AttributeError(f"{module} defines no function {name}")
    text = re.split(r"\n(?=[^\s)#])", source[start.start() :], maxsplit=1)[0]
    (node,) = ast.parse(text).body
    assert isinstance(node, ast.FunctionDef | ast.ClassDef)
    about = inspect.cleandoc(ast.get_docstring(node) or "")
    helps = _helps(about)
    arguments = _fields(node) if isinstance(node, ast.ClassDef) else _arguments(node, helps)
    read_arguments: dict[str, Option | Definition] = {}
    for argument, annotation, default, by_place, (metavar, help_text) in arguments:
        kind, many, notes = _kind(annotation)
        if kind in MAKERS or "options" in notes:
            maker = MAKERS.get(kind) or f"{_origin(kind, module, source)}:{kind}"
            read_arguments[argument] = read(maker, by_place)
        elif kind is not None and "python" not in notes:
            value = inspect.Parameter.empty if default is None else _literal(default, source)
            help_text = help_text or (JSON if argument == "as_json" else "")
            option = Option(argument, kind, many, by_place, value, notes, metavar, help_text)
            read_arguments[argument] = option
    rest = node.args.kwarg.arg if isinstance(node, ast.FunctionDef) and node.args.kwarg else ""
    reference = re.match(r"As of ([\w.]+)\.(\w+)(?:, without ([\w, ]+))?", helps.get(rest, (None, ""))[1])
    if isinstance(node, ast.FunctionDef) and reference is not None:
        further = read(f"finssim.{reference[1]}:{reference[2]}")
        names = {argument.arg for argument in node.args.args + node.args.kwonlyargs}
        names |= set((reference[3] or "").split(", "))
        read_arguments |= {name: one for name, one in further.arguments.items() if name not in names}
    lines_of_help = re.split(r"\n(?:Args|Returns|Raises|Note):\n", about)[0].replace("`", "")
    extra = isinstance(node, ast.FunctionDef) and node.args.vararg is not None
    tabled = re.search(r"^def tables_of\(", source, re.MULTILINE) is not None
    return Definition(path, lines_of_help, read_arguments, positional, extra, tabled)


Help = tuple[str | None, str]
"""METAVAR, and help text."""
Arguments = Iterator[tuple[str, ast.expr | None, ast.expr | None, bool, Help]]
"""Name, annotation, default, whether it is positional, and help."""


def _arguments(function: ast.FunctionDef, helps: Mapping[str, Help]) -> Arguments:
    arguments = function.args
    defaults = [
        *[None] * (len(arguments.args) - len(arguments.defaults)),
        *arguments.defaults,
        *arguments.kw_defaults,
    ]
    for k, (a, default) in enumerate(zip([*arguments.args, *arguments.kwonlyargs], defaults, strict=True)):
        yield a.arg, a.annotation, default, k < len(arguments.args), helps.get(a.arg, (None, ""))


def _fields(settings: ast.ClassDef) -> Arguments:
    """Yield the fields, each with the string below it as help."""
    for field, below in pairwise([*settings.body, ast.Pass()]):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
            text = ast.literal_eval(below.value) if isinstance(below, ast.Expr) else ""
            match = re.match(r"(?:\((.*?)\) )?(.*)", text, re.DOTALL)
            assert match is not None
            help_text = " ".join(match[2].replace("`", "").split())
            yield field.target.id, field.annotation, field.value, False, (match[1], help_text)


def _helps(about: str) -> dict[str, Help]:
    """Return argument -> its METAVAR, if it has one, and its help text."""
    section = re.search(r"^Args:\n((?: .*\n?|\n(?= ))*)", about, re.MULTILINE)
    entries = re.split(r"^ {4}(?=\w)", section[1], flags=re.MULTILINE)[1:] if section else []
    helps = {}
    for entry in entries:
        match = re.match(r"(\w+)(?: \((.*?)\))?:\s+(.*)", entry, re.DOTALL)
        assert match is not None, entry
        helps[match[1]] = (match[2], " ".join(match[3].replace("`", "").split()))
    return helps


def _kind(annotation: ast.expr | None) -> tuple[Any, bool, tuple[Any, ...]]:
    """Return the type of an argument, whether it may be repeated, and the notes of `Annotated`; None if it is
    not an option."""
    if isinstance(annotation, ast.BinOp):
        sides = (_kind(annotation.left), _kind(annotation.right))
        return next((side for side in sides if side[0] is not None), sides[0])
    if isinstance(annotation, ast.Subscript):
        head = ast.unparse(annotation.value)
        if head == "Annotated" and isinstance(annotation.slice, ast.Tuple):
            first, *others = annotation.slice.elts
            kind, many, _ = _kind(first)
            notes = tuple(map(ast.literal_eval, others))
            if "options" in notes:
                return ast.unparse(first), False, notes
            return kind, many and "," not in notes, notes
        if head in ("Sequence", "list"):
            return _kind(annotation.slice)[0], True, ()
        return KINDS.get(head), False, ()
    name = annotation.id if isinstance(annotation, ast.Name) else ""
    return KINDS.get(name, name if name in MAKERS else None), False, ()


def _literal(default: ast.expr, source: str) -> Any:
    """Return a default value; a name stands for a constant of the module."""
    if isinstance(default, ast.Call) and ast.unparse(default.func) == "Path":
        return Path(ast.literal_eval(default.args[0]))
    if isinstance(default, ast.Name):
        constant = re.search(rf"^{default.id}(?:: .*)? = (.+?)(?:  #.*)?$", source, re.MULTILINE)
        assert constant is not None, default.id
        return ast.literal_eval(constant[1])
    return ast.literal_eval(default)


def command_app(
    sections: Mapping[str, Mapping[str, str]],
    groups: Mapping[str, str],
    further: Family | None = None,
    **settings: Any,
) -> typer.Typer:
    """Return the command line with all commands.

    Args:
        sections: Heading of the help -> command -> function, as module:function. A command with the name of a
            group runs if no subcommand follows; other groups then print their help.
        groups: Name -> help of a group without a command of its own.
        further: Commands of extensions and other packages, each read when it is used.
        settings: Settings of the outermost `typer.Typer`.
    """
    commands = {name: work for section in sections.values() for name, work in section.items()}

    def others() -> dict[str, None]:
        return dict.fromkeys(
            name.partition(" ")[0] for name in ([] if further is None else further.of_packages())
        )

    class Sections(typer.core.TyperGroup):
        """Commands by section, in the given order, followed by those of other packages."""

        def list_commands(self, context: Any) -> list[str]:
            return [*super().list_commands(context), *others()]

        def get_command(self, context: Any, name: str) -> Any:
            known = super().get_command(context, name)
            return _registered(name) if known is None and name in others() else known

        def format_commands(self, context: Any, formatter: Any) -> None:
            width = max(len(word) for word in (*self.commands, *others()))
            for heading, section in sections.items():
                words = dict.fromkeys(name.partition(" ")[0] for name in section)
                room = formatter.width - width - 6
                rows = [(f"{word:{width}}", self.commands[word].get_short_help_str(room)) for word in words]
                with formatter.section(heading):
                    formatter.write_dl(rows)
            if others():
                room = formatter.width - width - 6
                rows = [(f"{word:{width}}", _short_help(word, room)) for word in others()]
                with formatter.section("Extensions"):
                    formatter.write_dl(rows)

    app = typer.Typer(**SETTINGS, **settings, cls=Sections)
    _add(app, commands, groups)
    return app


def _add(app: typer.Typer, commands: Mapping[str, str], groups: Mapping[str, str]) -> None:
    """Add commands of one or two words to a command line."""
    apps: dict[str, typer.Typer] = {}
    for name, work in commands.items():
        first, _, last = name.partition(" ")
        is_group = any(other.startswith(f"{name} ") for other in commands)
        if is_group or (last and first not in apps):
            apps[first] = typer.Typer(**SETTINGS, invoke_without_command=True)
            app.add_typer(apps[first], name=first)
            handler = (
                _handler(name, work, group=True) if is_group else _group(groups.get(first) or about(work))
            )
            apps[first].callback()(handler)
        if not is_group:
            handler = _handler(name, work)
            extra = getattr(handler, "definition").extra  # noqa: B009
            options = {"allow_extra_args": True, "ignore_unknown_options": True} if extra else None
            (apps[first] if last else app).command(last or first, context_settings=options)(handler)


def _registered(word: str) -> Any:
    """Return the command of an extension or another package by its first word, with its subcommands.

    Raises:
        RegistryError: Its module cannot be found or imported, or has no such function.
    """
    names = [name for name in COMMANDS.of_packages() if name.partition(" ")[0] == word]
    references = {name: COMMANDS.reference(name) for name in names}
    app = typer.Typer(**SETTINGS)
    app.callback()(lambda: None)
    try:
        _add(app, references, {})
    except Exception as error:  # a package's code may raise anything when it is imported
        raise RegistryError(
            f"command '{word}' of package {COMMANDS.packages()[names[0]]} cannot be used: {references[names[0]]}: "
            f"{type(error).__name__}: {error}; repair or uninstall that package"
        ) from error
    return typer.main.get_command(app).commands[word]  # type: ignore[attr-defined]


def _short_help(name: str, room: int) -> str:
    """Return the first sentence of a command of another package, or a note that it cannot be used."""
    try:
        return str(_registered(name).get_short_help_str(room))
    except RegistryError:
        return "cannot be used: see finssim doctor"


def run_script(path: str) -> NoReturn:
    """Run a function as a program with the options of its signature, and exit.

    Args:
        path: The function, module:function; the module may be `__main__`.
    """
    app = typer.Typer(**SETTINGS, pretty_exceptions_enable=False, context_settings=CONTEXT)
    app.command()(_handler(path.rpartition(":")[2], path))
    replace_unwritable(sys.stdout, sys.stderr)
    sys.exit(boundary.run(app, sys.argv[1:], script=path.partition(":")[0]))


def _group(title: str) -> Callable[..., None]:
    def show(context: typer.Context) -> None:
        if context.invoked_subcommand is None:
            typer.echo(context.get_help())

    show.__doc__ = title
    show.__annotations__ = {"context": typer.Context, "return": None}
    return show


def _handler(name: str, path: str, *, group: bool = False) -> Callable[..., Any]:
    """Return a function with the signature for Typer, which calls the original one."""
    definition = read(path)
    options = list(definition.all_options())
    if definition.tabled:
        options.append(Option("as_json", bool, False, False, False, (), None, JSON))

    def handle(context: typer.Context, **typed: Any) -> Any:
        if group and context.invoked_subcommand is not None:
            return None
        with ExitStack() as locks:
            for place in _directories(options, typed):
                locks.enter_context(sole_writer(place))
            if definition.tabled:
                return _experiment(name, definition, typed)
            return _status(definition.call(typed, *(context.args if definition.extra else ())))

    context = inspect.Parameter("context", inspect.Parameter.POSITIONAL_OR_KEYWORD, annotation=typer.Context)
    parameters = [context, *(option.parameter() for option in options)]
    handle.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    handle.__annotations__ = {p.name: p.annotation for p in parameters}
    handle.__doc__ = definition.help
    handle.definition = definition  # type: ignore[attr-defined]
    return handle


def _directories(options: Sequence[Option], typed: Mapping[str, Any]) -> list[Path]:
    """Return the directories that a command writes, which no other command may write at the same time."""
    return [
        typed[option.name] if typed[option.name] is not None else option.default
        for option in options
        if option.name in WRITTEN
        and option.metavar in ("DIR", "DATASET")
        and (typed[option.name] or option.default)
    ]


def _experiment(name: str, definition: Definition, typed: Mapping[str, Any]) -> int:
    from finssim.evaluation.campaign import run_experiment

    path = definition.path
    work, tables = loaded(path), loaded(f"{path.partition(':')[0]}:tables_of")
    options = {"bar": typed.get("robot") is None, "as_json": typed["as_json"]}
    return _status(run_experiment(name, work, tables, **options, **definition.values(typed)))


def _status(result: Any) -> int:
    """Return the exit status: the result if it is a number; 3 if it is a result that is not `ok`; else 0."""
    if isinstance(result, Mapping):
        return 0 if result.get("ok", True) else 3
    return result if type(result) is int else 0
