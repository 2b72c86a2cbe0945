"""A learned threat function: models for all kinds of hazard, and the sub-R-MDPs they hold for."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rp_jax.hazards import SubRMDP
from rp_jax.threat import artefact
from rp_jax.threat.correction import SumCorrection, correction_of
from rp_jax.threat.model import ThreatModel


@dataclass(frozen=True)
class ThreatFunction:
    """The threats of all actions, learned in the sub-R-MDPs of an environment (Algorithm 2).

    It holds for any reward, any number of hazards and any threshold, as long as the body, its
    baseline policy and the kinds of hazard are the same.
    """

    models: dict[str, ThreatModel]  # by kind of hazard; empty under plans if all are fixed
    subs: dict[str, SubRMDP]  # by kind of hazard, the sub-R-MDPs that the models hold for
    about: dict[str, Any] = field(default_factory=dict)  # reports, settings, curves and times

    def save(self, folder: str | Path, environment: str = "") -> None:
        """Saves the models, the sub-R-MDPs that they hold for, and their reports.

        Args:
            folder: created if it is missing.
            environment: name of the environment; by default of the one that it was learned in.

        Raises:
            storage.StorageError: the folder or a file cannot be written.
        """
        learned_in = self.about.get("environment") or self.about.get("spec", {}).get("env", "")
        name = environment or str(learned_in)
        artefact.save(Path(folder), name, self.models, self.subs, self.about)

    @property
    def correction(self) -> SumCorrection | None:
        """The correction of sums over hazards that calibration found; None without calibration."""
        return correction_of(self.about.get("correction"))

    def __repr__(self) -> str:
        sums, parts = self.about.get("sums", {}), []
        for kind in self.models:
            mae = sums.get(kind, {}).get("mae")
            parts.append(kind if mae is None else f"{kind} (mean absolute error of sums {mae:.2g})")
        return f"ThreatFunction({', '.join(parts)})"

    @property
    def checksum(self) -> str:
        """The SHA-256 of the models and the sub-R-MDPs that they hold for."""
        return artefact.checksum(self.models, self.subs)

    def check_fits(self, subs: Mapping[str, SubRMDP], where: str = "threat") -> None:
        """Raises StorageError unless the function holds for an environment.

        Args:
            subs: the environment's sub-R-MDPs by kind of hazard.
            where: beginning of the message.

        Raises:
            storage.StorageError: the body, its baseline policy or a hazard differs.
        """
        artefact.same_kinds(where, self.models, subs)
        for kind, sub in subs.items():
            artefact.same_sub(f"{where}: {kind}", self.subs[kind], sub)


def load_threat(folder: str | Path, subs: Mapping[str, SubRMDP]) -> ThreatFunction:
    """Loads a threat function for an environment.

    Args:
        folder: the folder that it was saved in.
        subs: the environment's sub-R-MDPs by kind of hazard, from `env.sub_rmdps(params)`.

    Raises:
        storage.StorageError: there is no threat function, it is damaged, or it holds for another
            environment.
    """
    return ThreatFunction(*artefact.load(Path(folder), subs), artefact.about(Path(folder)))
