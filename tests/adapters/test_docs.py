import re
from pathlib import Path

import jax
import pytest
from quick import compile_soon  # noqa: F401

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(("page", "count"), [("README.md", 2), ("docs/adapters.md", 6)])
def test_what_the_docs_show_runs(page, count, monkeypatch):
    monkeypatch.chdir(ROOT)
    snippets = re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)
    assert len(snippets) == count
    with jax.numpy_rank_promotion("allow"):
        exec("\n".join(snippets), {})
