import functools
import re
from pathlib import Path

import jax
import pytest
from quick import compile_soon  # noqa: F401
from tiny import moment

import rp_jax
from rp_jax.threat.fit import FitConfig

ROOT = Path(__file__).parents[2]


def snippets(page):
    return re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)


def test_the_readme_needs_fourteen_lines_and_two_imports():
    code = "\n".join(snippets("README.md")).splitlines()
    lines = [line for line in code if line.strip()]
    assert len(lines) <= 14
    assert len({line for line in lines if line.startswith(("import", "from rp_jax"))}) <= 3
    first = [line for line in snippets("README.md")[0].splitlines() if " import " in f" {line}"]
    assert len(first) == 2


def test_the_readme_trains_evaluates_loads_and_acts(monkeypatch, tmp_path, capsys):
    """Its code as it stands, but with settings of a moment where it takes the defaults."""
    monkeypatch.chdir(tmp_path)
    fit = FitConfig(hidden=(16,), steps=40, batch=64)
    threat = rp_jax.ThreatConfig(states=200, paths=4, test_states=200, test_paths=8, fit=fit)
    loop = rp_jax.LoopConfig(steps=480, num_envs=8, batch=32, replay=512, replay_start=64, n_step=2)
    few = functools.partial(rp_jax.evaluate)
    monkeypatch.setattr(rp_jax, "reconnoitre", functools.partial(rp_jax.reconnoitre, config=threat))
    monkeypatch.setattr(rp_jax, "plan", functools.partial(rp_jax.plan, config=loop))
    monkeypatch.setattr(
        rp_jax, "evaluate", lambda key, agents, episodes: few(key, agents, episodes=16)
    )
    names: dict = {}
    with moment():
        for code in snippets("README.md"):
            names = {}
            exec(code, names)
    assert "crashes" in capsys.readouterr().out
    assert names["action"].shape == ()
    assert (tmp_path / "jam" / "threat" / "manifest.json").exists()


@pytest.mark.slow
@pytest.mark.parametrize(("page", "count"), [("docs/adapters.md", 6)])
def test_what_the_docs_show_runs(page, count, monkeypatch):
    monkeypatch.chdir(ROOT)
    assert len(snippets(page)) == count
    with jax.numpy_rank_promotion("allow"):
        exec("\n".join(snippets(page)), {})


LINK = re.compile(r"\]\(([^)#\s]+)(#[^)\s]*)?\)")


@pytest.mark.parametrize(
    "page",
    sorted(
        str(path.relative_to(ROOT))
        for path in (*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), ROOT / "docs/results/README.md")
    ),
)
def test_links_lead_somewhere(page):
    links = [(link, anchor) for link, anchor in LINK.findall((ROOT / page).read_text())]
    here = [link for link, _ in links if "://" not in link]
    missing = [link for link in here if not (ROOT / page).parent.joinpath(link).exists()]
    assert missing == []
