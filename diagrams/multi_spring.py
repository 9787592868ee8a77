"""A circle in the plane while three springs pull (CC 4.2, Fig. 5 to 7)."""

from dataclasses import dataclass, field

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Diagram, LeafSystem

from makebreak.diagrams.planar import (
    FORCE_MAX,
    MASS,
    PERIOD,
    circle_of_seed,
    make_planar,
)
from makebreak.systems.baselines.active_inference import (
    ActiveInference,
    ActiveInferenceConfig,
)
from makebreak.systems.baselines.biomimetic import Biomimetic, BiomimeticConfig
from makebreak.systems.baselines.mrac import Mrac, MracConfig
from makebreak.systems.numerics.igmm import IgmmConfig
from makebreak.systems.planar_impedance import (
    ForceModelConfig,
    PlanarImpedance,
    PlanarImpedanceConfig,
)
from makebreak.systems.planar_world import CircleTargetConfig, PlanarWorldConfig

# Before the seed varies them: the springs' anchors [m], stiffness [N/m], rest length
# [m]. On the circle they pull with 7 to 40 N.
DISTANCE, DIRECTIONS = 0.75, np.radians([90.0, 210.0, 330.0])
STIFFNESS, REST_LENGTH = np.array([20.0, 40.0, 60.0]), 0.3


# All as scripts/tune_planar.py found them on seeds 100 to 113; see docs/planar.md.
def _impedance() -> PlanarImpedanceConfig:
    return PlanarImpedanceConfig(
        stiffness_free=110.0, damping_ratio=2.0, steepness=11.9, error_mid=1.78
    )


def _model() -> ForceModelConfig:
    sigma = 2 * [0.0132] + 4 * [2.17]
    mixture = IgmmConfig(sigma_ini=sigma, tau_nov=0.0438, sp_max=55.7)
    return ForceModelConfig(mixture, period_sec=0.001)


def _mrac() -> MracConfig:
    return MracConfig(
        omega=1.89,
        zeta=1.81,
        rate_weight=0.0611,
        force_gains=[3572.0, 357200.0],
        position_gains=[1.45, 10000.0],
        velocity_gains=[0.0323, 1.23],
    )


def _active_inference() -> ActiveInferenceConfig:
    return ActiveInferenceConfig([1.0, 0.79, 0.235, 100.0], 8.71, 395.0)


def _biomimetic() -> BiomimeticConfig:
    return BiomimeticConfig(
        kappa=12.0,
        rates=[24.5, 21900.0, 71.4],
        stiffness=188.0,
        damping=9.187,
        forget=0.00422,
        forget_less=123.0,
    )


@dataclass
class BaselinesConfig:
    mrac: MracConfig = field(default_factory=_mrac)
    active_inference: ActiveInferenceConfig = field(default_factory=_active_inference)
    biomimetic: BiomimeticConfig = field(default_factory=_biomimetic)


@dataclass
class MultiSpringConfig:
    seed: int = 0  # Draws start, direction, springs and noise.
    trials: int = 30  # Of the biomimetic controller.
    # Half width of the uniform draw of each spring's stiffness and distance.
    spread: float = 0.2
    force_noise: float = 0.2  # Standard deviation, each axis [N].
    impedance: PlanarImpedanceConfig = field(default_factory=_impedance)
    model: ForceModelConfig = field(default_factory=_model)
    baselines: BaselinesConfig = field(default_factory=BaselinesConfig)


def draw(config: MultiSpringConfig) -> tuple[PlanarWorldConfig, CircleTargetConfig]:
    """The world and the circle of the config's seed."""
    c = config
    if c.seed < 0:
        raise ValueError(f"seed is {c.seed}, expected 0 or more")
    if c.trials < 1:
        raise ValueError(f"trials is {c.trials}, expected 1 or more")
    if not 0.0 <= c.spread < 1.0:
        raise ValueError(f"spread is {c.spread}, expected 0 <= spread < 1")
    if not 0.0 <= c.force_noise < np.inf:
        raise ValueError(f"force_noise is {c.force_noise}, expected >= 0")
    rng = np.random.default_rng(c.seed)
    target = circle_of_seed(rng)
    distance = DISTANCE * (1.0 + c.spread * rng.uniform(-1.0, 1.0, 3))
    stiffness = STIFFNESS * (1.0 + c.spread * rng.uniform(-1.0, 1.0, 3))
    anchors = distance[:, None] * np.column_stack(
        [np.cos(DIRECTIONS), np.sin(DIRECTIONS)]
    )
    world = PlanarWorldConfig(
        mass=MASS,
        anchors=anchors.tolist(),
        stiffness=stiffness.tolist(),
        rest_length=3 * [REST_LENGTH],
        period_sec=PERIOD,
    )
    return world, target


def make_multi_spring(
    config: MultiSpringConfig, controller: LeafSystem, meshcat: Meshcat | None = None
) -> Diagram:
    """The closed loop of make_planar with this controller, in the seed's world."""
    world, target = draw(config)
    return make_planar(
        controller, world, target, config.force_noise, config.seed, meshcat
    )


def impedance(config: PlanarImpedanceConfig, model: ForceModelConfig, knowledge=None):
    """Our controller."""
    return PlanarImpedance(config, model, MASS, FORCE_MAX, knowledge, PERIOD)


def mrac(config: MracConfig):
    return Mrac(config, FORCE_MAX, PERIOD)


def active_inference(config: ActiveInferenceConfig):
    return ActiveInference(config, FORCE_MAX, PERIOD)


def biomimetic(config: BiomimeticConfig, knowledge=None, duration_sec: float = 6.0):
    """Args: knowledge, what earlier trials taught."""
    return Biomimetic(config, duration_sec, knowledge, MASS, FORCE_MAX, PERIOD)
