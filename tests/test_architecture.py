import ast
import collections
import functools
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
OUTER = ("rp_jax.adapters", "rp_jax.plot")  # the only ones that import libraries for show
FOREIGN = ("brax", "matplotlib", "gymnasium")


def linted(folder):
    """(whether all contracts of pyproject.toml are kept, what is said) of the library there."""
    command = [Path(sys.executable).with_name("lint-imports"), "--no-cache"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder, check=False)
    return done.returncode == 0, done.stdout + done.stderr


def test_every_part_imports_only_what_it_may():
    kept, said = linted(ROOT)
    assert kept, said
    assert "0 broken" in said


WRONG = {
    # name: (module, line added to it, contract)
    "a layer above": ("hazards/bomb.py", "from rp_jax.envs import jam", "below it"),
    "a layer above, later": ("shield.py", "def f():\n    import rp_jax.planning.loop", "below it"),
    "a sibling": ("plot/maps.py", "from rp_jax.adapters import gymnasium", "below it"),
    "the core, of the rim": ("rollout.py", "import rp_jax.adapters.registry", "below it"),
    "a simulator": ("envs/jam.py", "from brax import envs", "at the rim"),
    "an adapter's library": ("plot/maps.py", "import gymnasium", "at the rim"),
    "figures": ("evaluation.py", "import matplotlib.pyplot as plt", "at the rim"),
    "the terminal": ("planning/loop.py", "from rich.console import Console", "at the rim"),
    "an experiment": ("rare.py", "from experiments import jam", "built on it"),
    "a test": ("rare.py", "import tests.probe", "built on it"),
    "a part without a place": ("other.py", '"""Anything."""', "below it"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_import_would_be_noticed(name, tmp_path):
    module, line, contract = WRONG[name]
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    skip = shutil.ignore_patterns("__pycache__", "*.npz")
    shutil.copytree(ROOT / "rp_jax", tmp_path / "rp_jax", ignore=skip)
    with (tmp_path / "rp_jax" / module).open("a") as file:
        file.write(f"\n{line}\n")
    kept, said = linted(tmp_path)
    assert not kept
    broken = [line for line in said.splitlines() if " BROKEN" in line]
    assert len(broken) == 1, said
    assert contract in broken[0], said


@functools.cache
def modules(package="rp_jax"):
    """By dotted name, the parsed modules of a package."""
    found = {}
    for path in sorted((ROOT / package).rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        found[name] = ast.parse(path.read_text(), str(path))
    return found


def running(tree):
    """The nodes of a module but for what only type checkers read."""
    for node in ast.iter_child_nodes(tree):
        if not (isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING")):
            yield node
            yield from running(node)


def imports(tree):
    """The dotted names that a module imports, anywhere in it."""
    for node in running(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def belongs(name, package):
    return name == package or name.startswith(f"{package}.")


@pytest.mark.parametrize("package", ["experiments", "examples", "benchmarks"])
def test_nothing_imports_what_stands_above_it(package):
    """Of the library, the linter tells."""
    above = {"experiments": {"examples", "benchmarks"}}
    assert len(modules(package)) > 3
    for name, tree in modules(package).items():
        used = {imported.split(".")[0] for imported in imports(tree)}
        assert used.isdisjoint({"tests", *above.get(package, ())}), name


def run(code):
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def test_importing_the_core_loads_none_of_them():
    core = [name for name in modules() if not name.startswith(OUTER)]
    lines = [f"import {name}" for name in core]
    lines += ["import sys", f"print(*[m for m in {FOREIGN!r} if m in sys.modules])"]
    assert run("\n".join(lines)) == []


ADAPTERS = {"brax": ["brax", "physics"], "gymnasium": ["gymnasium"]}


@pytest.mark.parametrize("library", ADAPTERS)
def test_adapters_alone_import_their_library(library):
    users = {
        name
        for name, tree in modules().items()
        if library in {imported.split(".")[0] for imported in imports(tree)}
    }
    assert users == {f"rp_jax.adapters.{adapter}" for adapter in ADAPTERS[library]}


@pytest.mark.parametrize(
    ("adapter", "library"),
    [(adapter, library) for library, adapters in ADAPTERS.items() for adapter in adapters],
)
def test_an_adapter_loads_its_own_library_only(adapter, library):
    others = [name for name in FOREIGN if name != library]
    loaded = f"print(*[m for m in {others!r} if m in sys.modules])"
    assert run(f"import rp_jax.adapters.{adapter}, sys; {loaded}") == []  # nor is it noisy
    assert run("import rp_jax.adapters.registry, sys; print('brax' in sys.modules)") == ["False"]


@pytest.mark.parametrize(
    ("adapter", "library", "advice"),
    [
        ("brax", "brax", "pip install brax"),
        ("physics", "brax", "pip install brax"),
        ("gymnasium", "gymnasium", r"pip install 'rp_jax[gymnasium]'"),
    ],
)
def test_without_its_library_an_adapter_says_what_to_install(adapter, library, advice):
    lines = [
        "import sys",
        f"sys.modules[{library!r}] = None",
        "try:",
        f"    import rp_jax.adapters.{adapter}",
        "except ImportError as error:",
        "    print(error)",
    ]
    assert advice in " ".join(run("\n".join(lines)))


IMPORT_ALL = """
import importlib, os, pkgutil, signal, sys, types, warnings
told = os.fdopen(os.dup(1), "w")
sys.stdout = sys.stderr = None  # whatever asks for a terminal fails
for foreign in FOREIGN:
    importlib.import_module(foreign)  # what these change is not ours

def state():
    handlers = {number: signal.getsignal(number) for number in signal.valid_signals()}
    members = {
        (name, member): id(value)  # modules come when they are first used
        for name in (*FOREIGN, "jax", "jax.numpy", "jax.random", "numpy", "builtins")
        for member, value in vars(sys.modules[name]).items()
        if not isinstance(value, types.ModuleType)
    }
    settings = list(warnings.filters), dict(os.environ), os.getcwd(), record.flags()
    return handlers, members, settings

from rp_jax.runs import record
before = state()
for package in PACKAGES:
    root = importlib.import_module(package)
    for found in pkgutil.walk_packages(root.__path__, package + "."):
        importlib.import_module(found.name)
        if state() != before:
            told.write(found.name + " ")
from rp_jax.cli import terminal
told.write(f"modules {sum(name.startswith('rp_jax.') for name in sys.modules)} ")
told.write(f"terminals {terminal.console.cache_info().currsize}")
"""


def test_importing_anything_asks_for_no_terminal_and_changes_nothing_of_the_process():
    libraries = (*FOREIGN, "matplotlib.pyplot", "flashbax", "optax", "scipy.stats", "tyro", "rich")
    code = f"FOREIGN, PACKAGES = {libraries}, ('rp_jax', 'experiments', 'examples')\n{IMPORT_ALL}"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    (_, modules, _, terminals) = done.stdout.split()
    assert int(modules) > 100
    assert terminals == "0"


def test_the_command_lines_load_no_figures():
    names = ["experiments.jam", "experiments.circuit", "experiments.point_gather"]
    assert run(f"import {', '.join(names)}, sys; print('matplotlib' in sys.modules)") == ["False"]


@pytest.mark.parametrize("part", sorted({name for name in modules() if name.count(".") >= 1}))
def test_there_are_no_cycles(part):
    """No module is imported, directly or not, by what it imports."""
    seen, todo = set(), [part]
    while todo:
        name = todo.pop()
        for imported in imports(modules()[name]):
            if not belongs(imported, "rp_jax"):
                continue
            target = imported if imported in modules() else imported.rpartition(".")[0]
            assert target in modules(), f"{name} imports {imported}, which does not exist"
            assert target != part, f"{part} is imported by {name}, which it imports"
            if target not in seen:
                seen.add(target)
                todo.append(target)


def names_twice(found):
    """Names that more than one of the (name, module) pairs has, with these modules."""
    homes = collections.defaultdict(list)
    for name, module in found:
        homes[name].append(module)
    return {name: homes[name] for name in homes if len(homes[name]) > 1}


def public_classes(tree):
    classes = [node.name for node in tree.body if isinstance(node, ast.ClassDef)]
    return [name for name in classes if not name.startswith("_")]


OF_EACH_ENVIRONMENT = {"State", "Params"}


def test_no_two_modules_have_the_same_name():
    found = names_twice((name.rpartition(".")[2], name) for name in modules())
    assert found == {}


def test_no_two_public_classes_have_the_same_name():
    pairs = [(name, home) for home, tree in modules().items() for name in public_classes(tree)]
    found = names_twice(pairs)
    homes = [home for name in OF_EACH_ENVIRONMENT for home in found.pop(name)]
    assert found == {}
    assert all(home.startswith("rp_jax.envs.") for home in homes)


def test_a_name_that_is_taken_would_be_noticed():
    pairs = [("report", "a.report"), ("fit", "a.fit"), ("report", "b.report")]
    assert names_twice(pairs) == {"report": ["a.report", "b.report"]}
    assert public_classes(ast.parse("class A: ...\nclass _B: ...\ndef c(): ...")) == ["A"]


def undocumented(tree):
    """Names of public modules, classes and functions without a docstring; methods too."""

    def visit(node, prefix):
        if not ast.get_docstring(node):
            yield prefix or "the module"
        for child in node.body:
            if getattr(child, "name", "_").startswith("_"):
                continue
            if isinstance(child, ast.ClassDef):
                yield from visit(child, f"{prefix}{child.name}.")
            elif not ast.get_docstring(child):
                yield f"{prefix}{child.name}"

    return list(visit(tree, ""))


@pytest.mark.parametrize("package", ["rp_jax", "experiments", "examples", "benchmarks"])
def test_all_that_is_public_is_documented(package):
    missing = {name: undocumented(tree) for name, tree in modules(package).items()}
    assert {name: found for name, found in missing.items() if found} == {}


def test_a_missing_docstring_would_be_noticed():
    tree = ast.parse('"""m"""\nclass A:\n    def f(self): ...\ndef g(): ...\ndef _h(): ...\n')
    assert undocumented(tree) == ["A.", "A.f", "g"]


def attributes(tree):
    """Dotted names in use, such as jax.random.key."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            parts = [node.attr]
            while isinstance(node.value, ast.Attribute):
                node = node.value
                parts.append(node.attr)
            if isinstance(node.value, ast.Name):
                yield ".".join([node.value.id, *reversed(parts)])


FORBIDDEN = ("PRNGKey", "np.random", "numpy.random", "jax.random.PRNGKey", "jax.debug")


def offences(tree):
    names = [*attributes(tree), *imports(tree)]
    found = [n for n in names if any(f".{bad}." in f".{n}." for bad in FORBIDDEN)]
    modules = ("pickle", "cloudpickle", "dill", "joblib", "random", "shelve")
    return found + [n for n in imports(tree) if n.split(".")[0] in modules]


@pytest.mark.parametrize("name", modules())
def test_no_old_keys_no_hidden_randomness_no_pickles(name):
    assert offences(modules()[name]) == []


@pytest.mark.parametrize(
    "line",
    [
        "jax.random.PRNGKey(0)",
        "np.random.rand()",
        "numpy.random.default_rng(0)",
        "from jax.random import PRNGKey",
        "from numpy import random",
        "import pickle",
        "import random",
        "jax.debug.print('x')",
    ],
)
def test_an_offence_would_be_noticed(line):
    assert offences(ast.parse(line))


def test_keyword_arguments_are_no_offence():
    assert offences(ast.parse("np.savez(f, allow_pickle=False); jax.random.key(0)")) == []
