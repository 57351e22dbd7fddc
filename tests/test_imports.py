"""Imports follow the layers, heavy libraries are imported only where needed, and importing is cheap."""

import ast
import subprocess
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from graphlib import TopologicalSorter
from importlib import import_module
from itertools import accumulate, chain
from pathlib import Path
from typing import NamedTuple

import pytest

from finssim.core.lazy import imported_lazily

SOURCE = Path(__file__).resolve().parents[1] / "src" / "finssim"
MODULES = sorted(SOURCE.rglob("*.py"))

ARROWS = {
    "core": {},
    "vehicles": {"core"},
    "physics": {"vehicles"},
    "control": {"physics"},
    "sim": {"control"},
    "localization": {"physics"},
    "tasks": {"sim", "localization"},
    "agents": {"tasks"},
    "learning": {"agents"},
    "trials": {"control"},
    "identification": {"trials", "sim"},
    "survey": {"identification", "localization"},
    "bench": {"identification"},
    "robot": {"agents", "localization", "identification"},
    "pool": {"robot"},
    "evaluation": {"identification", "learning", "pool"},
    "studies": {"evaluation", "survey"},
    "extensions.perception": {"evaluation"},
    "extensions.teams": {"agents"},
    "extensions.viewer": {"extensions.perception", "evaluation"},
    "extensions.ros2": {"extensions.perception", "pool"},
}
"""Layer -> the layers directly below it. A layer may import everything below; only extensions lie above extensions."""

TOP = {"workflow", "cli", "__main__"}
"""Modules that may import anything, and that only these modules import."""


HOMES = {
    "torch": {
        "learning/export.py",
        "learning/layers.py",
        "learning/learners/catalogue.py",
        "learning/learners/distill.py",
        "learning/learners/imitation.py",
        "learning/learners/rsl_rl_ppo.py",
        "learning/learners/sb3.py",
        "learning/learners/torchrl_ppo.py",
        "learning/network.py",
        "learning/parallel.py",
        "learning/torch_networks.py",
        "learning/resume.py",
        "learning/rsl_rl_env.py",
        "learning/tensors.py",
        "learning/torchrl_env.py",
        "tasks/torch_rotations.py",
        "tasks/torch_task.py",
    },
    "stable_baselines3": {
        "learning/learners/sb3.py",
        "learning/sb3.py",
    },
    "gymnasium": {
        "learning/demonstrations.py",
        "learning/gymnasium_env.py",
        "learning/pettingzoo_env.py",
    },
    "torchrl": {"learning/learners/torchrl_ppo.py", "learning/torchrl_env.py"},
    "tensordict": {
        "learning/learners/rsl_rl_ppo.py",
        "learning/learners/torchrl_ppo.py",
        "learning/rsl_rl_env.py",
        "learning/torchrl_env.py",
    },
    "rsl_rl": {"learning/learners/rsl_rl_ppo.py", "learning/rsl_rl_env.py"},
    "pettingzoo": {"learning/pettingzoo_env.py"},
    "minari": {"learning/demonstrations.py"},
    "ray": {"evaluation/campaign.py"},
    "casadi": {"agents/nmpc.py"},
    "newton": {"extensions/perception/model.py"},
    "onnx": {"learning/export.py"},
    "onnxruntime": {"control/policy.py"},
    "mujoco": {"extensions/perception/parts.py"},
    "pandas": {"sim/recorder.py"},
    "pyarrow": {"trials/trial_files.py", "sim/recorder.py"},
    "matplotlib": {
        "identification/fit.py",
        "identification/report.py",
        "identification/replay_report.py",
        "survey/camera.py",
        "survey/pool.py",
        "evaluation/figures.py",
        "vehicles/show.py",
    },
    "pymavlink": {
        "trials/importers/ardusub.py",
        "pool/ardusub.py",
        "pool/ardusub_sitl.py",
        "robot/links/mavlink.py",
    },
    "pyulog": {"trials/importers/ulog.py"},
    "rosbags": {
        "trials/importers/bag.py",
        "robot/record_messages.py",
        "extensions/ros2/codec.py",
    },
    "cv2": {
        "core/budget.py",
        "survey/boards.py",
        "survey/camera_fit.py",
        "survey/pool_search.py",
        "localization/detection/pictures.py",
        "robot/pictures.py",
        "extensions/perception/model.py",
        "cli/playback.py",
    },
    "pupil_apriltags": {"localization/detection/families.py"},
    "serial": {"robot/links/transports.py"},
    "mcap": {
        "core/mcap_files.py",
        "trials/importers/ardusub.py",
        "robot/recorder.py",
        "robot/record_reader.py",
    },
    "pygame": {"robot/teleop.py"},
    "cyclonedds": {
        "extensions/ros2/wire.py",
    },
    "rclpy": {
        "extensions/ros2/nodes/remote.py",
        "extensions/ros2/nodes/robot_node.py",
        "extensions/ros2/topics.py",
        "extensions/ros2/up.py",
        "extensions/ros2/worlds/clock.py",
        "extensions/ros2/worlds/sim.py",
        "extensions/ros2/worlds/virtual_pool.py",
    },
    "viser": {"extensions/viewer/app.py"},
}
"""Library -> the files that may import it, each of which does."""


def layer_of(parts: Sequence[str]) -> str:
    """Return the layer of a module's name below `finssim`; each extension is a layer."""
    return ".".join(parts[: 2 if parts[:1] == ("extensions",) else 1])


def layer(path: Path) -> str:
    """Return the package or top module of a source file; "" for the package itself."""
    parts = path.relative_to(SOURCE).with_suffix("").parts
    return layer_of(parts[:-1] if parts[-1] == "__init__" else parts)


LAYERS = {layer(path) for path in MODULES}


class Parsed(NamedTuple):
    """Parsed contents of a source file."""

    imports: frozenset[str]
    """Dotted names of all imported modules, inside functions too."""
    loaded: frozenset[str]
    """Modules that are imported when this one is."""
    classes: tuple[str, ...]


@cache
def parsed(path: Path) -> Parsed:
    """Parse a file, once."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    nodes = list(ast.walk(tree))
    classes = tuple(node.name for node in nodes if isinstance(node, ast.ClassDef))
    return Parsed(frozenset(names_of(nodes, path)), frozenset(names_of(executed(tree), path)), classes)


def names_of(nodes: Iterable[ast.AST], path: Path) -> set[str]:
    """Return the dotted names in the import statements among nodes."""
    names = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, (
                f"{path}: relative import: name modules in full, so that the arrows can be read"
            )
            names |= {str(node.module)} | {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def executed(tree: ast.Module) -> Iterator[ast.AST]:
    """Yield the statements that run when a module is imported."""
    nodes = list[ast.AST](tree.body)
    while nodes:
        node = nodes.pop()
        yield node
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            nodes += node.orelse
        elif not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            nodes += ast.iter_child_nodes(node)


def imported_layers(path: Path) -> set[str]:
    """Return the layers of FinsSim that a file imports."""
    ours = {layer_of(tuple(n.split("."))[1:]) for n in parsed(path).imports if n.split(".")[0] == "finssim"}
    return ours & LAYERS - {"", "extensions"}


def below(name: str) -> set[str]:
    """Return every layer that `name` may import: those directly below it, and theirs."""
    return set(chain.from_iterable({under} | below(under) for under in ARROWS.get(name, ())))


def test_every_module_has_its_place():
    """Each package and top module appears in the diagram of the layers."""
    assert LAYERS - {"", "extensions"} == ARROWS.keys() | TOP


def test_a_class_has_a_name_of_its_own():
    """No two classes of the package have the same name."""
    names = Counter(name for path in MODULES for name in parsed(path).classes)
    assert [name for name, count in names.items() if count > 1] == []


def test_imports_follow_the_arrows():
    """A module imports its own layer and layers below it; only the top imports the top."""
    against = {}
    for path in MODULES:
        own = layer(path)
        if own in TOP or path == SOURCE / "__init__.py":  # it imports lazily
            continue
        allowed = {own} | below(own)
        against[path.relative_to(SOURCE).as_posix()] = imported_layers(path) - allowed
    assert {path: layers for path, layers in against.items() if layers} == {}


def loaded_with(path: Path) -> set[str]:
    """Return the modules of FinsSim that a module imports when imported, without its parent packages."""
    own = dotted(path)
    parts = chain.from_iterable(accumulate(name.split("."), "{}.{}".format) for name in parsed(path).loaded)
    return {name for name in parts if name != own and not own.startswith(f"{name}.")}


def dotted(path: Path) -> str:
    """Return the module name of a file."""
    return ".".join(("finssim", *path.relative_to(SOURCE).with_suffix("").parts)).removesuffix(".__init__")


def test_no_module_imports_one_that_imports_it():
    """Any module can be imported first: the imports contain no cycle of any length."""
    graph = {dotted(path): loaded_with(path) for path in MODULES}
    known = {name: imported & graph.keys() for name, imported in graph.items()}
    sorter = TopologicalSorter(known)
    sorter.prepare()  # raises a CycleError that lists the cycle


def exporting() -> list[str]:
    """Return the packages that import their names on first use."""
    return [
        dotted(path)
        for path in MODULES
        if "\n__getattr__, __dir__ = exports(" in path.read_text(encoding="utf-8")
    ]


@pytest.mark.slow
@pytest.mark.parametrize("package", exporting())
def test_a_package_exports_what_it_says(package):
    """The export list matches the imports, each name can be imported, and none is the name of a submodule."""
    module = import_module(package)
    folder = Path(str(module.__file__)).parent
    modules = {path.stem for path in folder.glob("*.py")} | {
        path.parent.name for path in folder.glob("*/__init__.py")
    }
    assert not modules & set(module.__all__), "a module of that name would hide what is exported"
    defined = {name for name in vars(module) if getattr(vars(module)[name], "__module__", "") == package}
    lazily = set(dict(imported_lazily(str(module.__file__))))
    assert set(module.__all__) - {"__version__"} == lazily | {name for name in defined if name[0].isupper()}
    for name in module.__all__:
        assert getattr(module, name) is not None
        assert name in dir(module)
    with pytest.raises(AttributeError, match=f"module '{package}' has no attribute 'absent'"):
        module.absent  # noqa: B018


def test_the_package_imports_nothing_of_the_checkout():
    """The package is installed without studies, benchmarks and tools, so it imports none of them."""
    outside = {"studies", "benchmarks", "tools", "tests"}
    against = {path: parsed(path).imports for path in MODULES}
    assert not [path for path, names in against.items() if outside & {n.partition(".")[0] for n in names}]


def test_heavy_libraries_stay_at_home():
    """A heavy library is imported in the files that need it, and in no others."""
    importers = {library: set() for library in HOMES}
    for path in MODULES:
        for library in HOMES.keys() & {name.partition(".")[0] for name in parsed(path).imports}:
            importers[library].add(path.relative_to(SOURCE).as_posix())
    assert importers == HOMES


def fresh(script: str) -> str:
    """Return the standard output of a fresh Python."""
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return run.stdout


@pytest.mark.slow
@pytest.mark.parametrize(
    ("module", "absent"),
    [
        ("finssim", {"numpy", "warp", "typer", "pydantic", "torch", "matplotlib", "mujoco"}),
        ("finssim.cli.commands", {"numpy", "warp", "pydantic", "torch", "matplotlib", "mujoco"}),
        ("finssim.vehicles", {"warp", "torch", "matplotlib", "mujoco", "gymnasium"}),
        ("finssim.control", {"torch", "matplotlib", "mujoco", "gymnasium", "finssim.sim"}),
        (
            "finssim.sim",
            {"torch", "pandas", "pyarrow", "matplotlib", "mujoco", "gymnasium", "finssim.tasks"},
        ),
    ],
)
def test_a_part_costs_only_what_it_needs(module, absent):
    """Importing one part loads none of the libraries that only other parts need."""
    loaded = fresh(f"import sys, {module}; print(*sys.modules)").split()
    assert not absent & set(loaded)


@pytest.mark.slow
def test_importing_finssim_costs_less_than_importing_numpy():
    """`import finssim` in a fresh Python takes less time than `import numpy`, each the best of several runs."""
    script = "import time; t = time.perf_counter(); import {}; print(time.perf_counter() - t)"
    times = {"finssim": [], "numpy": []}
    for _ in range(5):
        for module, measured in times.items():
            measured.append(float(fresh(script.format(module))))
    assert min(times["finssim"]) < min(times["numpy"])
