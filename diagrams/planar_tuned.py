"""Settings of the planar experiments' controllers, found by papers/tune_planar.py."""

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from makebreak.diagrams.planar import LAB, MASS, PlanarSensing
from makebreak.systems.baselines.active_inference import ActiveInferenceConfig
from makebreak.systems.baselines.biomimetic import BiomimeticConfig
from makebreak.systems.baselines.mrac import MracConfig
from makebreak.systems.changing_contact.numerics.igmm import IgmmConfig
from makebreak.systems.planar.planar_impedance import (
    ForceModelConfig,
    PlanarImpedanceConfig,
)

TUNED_FILE = Path(__file__).with_name("planar_tuned.json")


@dataclass(frozen=True)
class Setting:
    """A task in which all controllers are tuned and compared."""

    world: str = "springs"  # Or "porridge", or "engaging": springs that let go.
    sensing: PlanarSensing = PlanarSensing()
    stiffness_max: float = 500.0  # Of every controller [N/m].

    @property
    def damping_max(self) -> float:
        """Twice critical at the greatest stiffness [N s/m]."""
        return 2.0 * 2.0 * float(np.sqrt(self.stiffness_max * MASS))


SETTINGS = {
    "springs": Setting(),
    "springs_lab": Setting(sensing=LAB),
    "engaging": Setting("engaging", LAB, stiffness_max=50.0),
    "porridge": Setting("porridge"),
}


def setting_of(name: str) -> Setting:
    """The setting of this name. Raises: ValueError for an unknown name."""
    if name not in SETTINGS:
        raise ValueError(f'setting is "{name}", expected one of {", ".join(SETTINGS)}')
    return SETTINGS[name]


@cache
def _tuned() -> dict:
    return json.loads(TUNED_FILE.read_text())


def _parts(setting: str, controller: str) -> list[dict]:
    return _tuned()[setting][controller]["config"]


def tuned_mrac(setting: str, controller: str = "mrac") -> MracConfig:
    """Args: setting, controller: names as in papers/tune_planar.py."""
    return MracConfig(**_parts(setting, controller)[0])


def tuned_active_inference(
    setting: str, controller: str = "active_inference"
) -> ActiveInferenceConfig:
    return ActiveInferenceConfig(**_parts(setting, controller)[0])


def tuned_biomimetic(setting: str, controller: str = "biomimetic") -> BiomimeticConfig:
    return BiomimeticConfig(**_parts(setting, controller)[0])


def tuned_impedance(
    setting: str, controller: str = "adaptive"
) -> tuple[PlanarImpedanceConfig, ForceModelConfig]:
    """The control law and the force model."""
    law, model = _parts(setting, controller)
    mixture = IgmmConfig(**model["mixture"])
    return PlanarImpedanceConfig(**law), ForceModelConfig(
        **(model | {"mixture": mixture})
    )
