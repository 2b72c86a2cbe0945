import ast
import functools
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
OUTER = ("rp_jax.adapters", "rp_jax.plot")  # the only ones that import libraries for show
FOREIGN = ("brax", "matplotlib", "gymnasium")

# From the left to the right, as data flow: each imports only from parts to its left, and parts of
# one place in the line not from one another.
ORDER = [
    {"validate", "storage", "devices", "arrays"},
    {"dynamics"},
    {"statistics", "shield", "checkpoints"},
    {"hazards"},
    {"envs"},
    {"recon"},
    {"threat"},
    {"planning", "tabular"},
    {"evaluate", "rare", "baselines"},
    {"plot", "adapters"},
]
PLACE = {part: i for i, parts in enumerate(ORDER) for part in parts}


@functools.cache
def modules(package="rp_jax"):
    """By dotted name, the parsed modules of a package."""
    found = {}
    for path in sorted((ROOT / package).rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        found[name] = ast.parse(path.read_text(), str(path))
    return found


def imports(tree):
    """The dotted names that a module imports, anywhere in it."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def part_of(name):
    """The file or folder of rp_jax that a dotted name belongs to, if any."""
    parts = name.split(".")
    return parts[1] if parts[0] == "rp_jax" and len(parts) > 1 else None


def belongs(name, package):
    return name == package or name.startswith(f"{package}.")


def test_every_part_has_its_place():
    assert len(modules()) > 20
    assert {part_of(name) for name in modules()} - {None} <= set(PLACE)


@pytest.mark.parametrize("name", modules())
def test_a_part_imports_only_from_its_left(name):
    here = part_of(name)
    for imported in imports(modules()[name]):
        there = part_of(imported)
        if there is None or there == here:
            continue
        assert there in PLACE, f"{name} imports {imported}, which has no place"
        assert here is not None, f"{name} imports {imported}; the package itself imports nothing"
        assert PLACE[there] < PLACE[here], f"{name} imports {imported}, which is to its right"


def test_the_line_would_notice_a_wrong_import():
    wrong = ast.parse(
        "def f():\n    from rp_jax.planning import loop\n    import rp_jax.evaluate\n"
    )
    assert [part_of(name) for name in imports(wrong)] == ["planning", "evaluate"]
    assert PLACE["planning"] > PLACE["threat"] > PLACE["envs"] > PLACE["hazards"]


@pytest.mark.parametrize("name", modules())
def test_libraries_for_show_are_imported_at_the_rim_only(name):
    if not name.startswith(OUTER):
        used = {imported.split(".")[0] for imported in imports(modules()[name])}
        assert used.isdisjoint({*FOREIGN, "experiments", "benchmarks", "rich", "tyro", "mujoco"})


@pytest.mark.parametrize("package", ["rp_jax", "experiments", "examples", "benchmarks"])
def test_nothing_imports_what_stands_above_it(package):
    above = {
        "rp_jax": {"experiments", "examples", "benchmarks"},
        "experiments": {"examples", "benchmarks"},
    }
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
    found = [n for n in names if any(f".{bad}" in f".{n}" for bad in FORBIDDEN)]
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
    ],
)
def test_an_offence_would_be_noticed(line):
    assert offences(ast.parse(line))


def test_keyword_arguments_are_no_offence():
    assert offences(ast.parse("np.savez(f, allow_pickle=False); jax.random.key(0)")) == []
