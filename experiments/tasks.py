"""The paper's tasks by name."""

from typing import Any

from experiments import circuit, jam, point_gather

EXPERIMENTS: dict[str, Any] = {"circuit": circuit, "jam": jam, "point_gather": point_gather}
