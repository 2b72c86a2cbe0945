"""Docstrings: first lines that speak for themselves, and every argument described."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

# Folders and files that the rules hold for, relative to the root of the repository.
HELD = ("rp_jax",)

# Methods of configurations that only check them: `name` begins the messages, always.
UNDESCRIBED = ("validate",)

VAGUE = re.compile(r"(Of|Those|That of|What|Whoever|As|Likewise|The same|See)\b")
SHAPE_ONLY = re.compile(r"\(([^()]|\([^()]*\))*\)[^A-Za-z]*$|\([^)]*\)( int| bool| float)?,? ")

Definition = ast.FunctionDef | ast.ClassDef | ast.Module


def _files() -> list[Path]:
    found: list[Path] = []
    for place in HELD:
        path = ROOT / place
        found += sorted(path.rglob("*.py")) if path.is_dir() else [path]
    return found


def _public(name: str) -> bool:
    return name == "__call__" or not name.startswith("_")


def _definitions(tree: ast.Module) -> Iterator[tuple[str, Definition]]:
    """Yields the module, its public classes and functions, and the public methods of the former."""
    yield "module", tree
    stack: list[tuple[str, ast.AST]] = [("", tree)]
    while stack:
        prefix, parent = stack.pop()
        for node in ast.iter_child_nodes(parent):
            if isinstance(node, ast.If | ast.Try | ast.With):
                stack.append((prefix, node))
            elif isinstance(node, ast.FunctionDef | ast.ClassDef) and _public(node.name):
                yield prefix + node.name, node
                if isinstance(node, ast.ClassDef):
                    stack.append((f"{prefix}{node.name}.", node))


def _arguments(function: ast.FunctionDef) -> list[str]:
    given = function.args
    names = [a.arg for a in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
    names += [f"*{given.vararg.arg}"] if given.vararg else []
    names += [f"**{given.kwarg.arg}"] if given.kwarg else []
    return [name for name in names if name not in ("self", "cls")]


def _undescribed(function: ast.FunctionDef) -> list[str]:
    """Returns the arguments that the docstring's section `Args:` does not name."""
    _, _, after = (ast.get_docstring(function) or "").partition("\nArgs:\n")
    section = re.split(r"\n(?=\S)", after)[0]
    named = re.findall(r"^    (\**\w+): \S", section, re.MULTILINE)
    return [name for name in _arguments(function) if name not in named]


def _fault(docstring: str | None) -> str | None:
    """Returns what is wrong with the first line of a docstring, or None."""
    first = (docstring or "").partition("\n")[0]
    if not first.endswith("."):
        return f"does not end with a period: {first!r}"
    if len(first.split()) < 3:
        return f"has fewer than three words: {first!r}"
    if VAGUE.match(first):
        return f"does not say by itself what it is: {first!r}"
    if SHAPE_ONLY.match(first):
        return f"begins with a shape: {first!r}"
    return None


@pytest.mark.parametrize("path", _files(), ids=lambda path: str(path.relative_to(ROOT)))
def test_first_lines(path):
    found = _definitions(ast.parse(path.read_text()))
    faults = {name: _fault(ast.get_docstring(node)) for name, node in found}
    assert {name: fault for name, fault in faults.items() if fault} == {}


@pytest.mark.parametrize("path", _files(), ids=lambda path: str(path.relative_to(ROOT)))
def test_arguments(path):
    faults = {
        name: _undescribed(node)
        for name, node in _definitions(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef) and node.name not in UNDESCRIBED
    }
    assert {name: fault for name, fault in faults.items() if fault} == {}


@pytest.mark.parametrize(
    "first",
    [
        "Of one step.",
        "Those of a part.",
        "What is near.",
        "See `HazardSource`.",
        "(B, A) total threat of a batch.",
        "() int, the least threatening action.",
        "(...) bool for positions.",
        "Two words.",
        "Returns the threat",
        "",
    ],
)
def test_riddles_are_found(first):
    assert _fault(first)


@pytest.mark.parametrize(
    "first",
    ["Returns the least threatening action.", "A vehicle's pose and speed.", "Ofsted is no rule."],
)
def test_plain_lines_pass(first):
    assert _fault(first) is None


def test_missing_arguments_are_found():
    source = '''
def f(a, *, b, **rest):
    """Returns the sum.

    Args:
        a: a number; its
            second line mentions b: not a description of it.

    Returns:
        b: is not described here.
    """
'''
    (function,) = ast.parse(source).body
    assert isinstance(function, ast.FunctionDef)
    assert _undescribed(function) == ["b", "**rest"]
