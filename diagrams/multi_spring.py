"""A circle in the plane while three springs pull (CC 4.2, Fig. 5 to 7)."""

from dataclasses import dataclass, field, replace

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
from makebreak.diagrams.planar_tuned import (
    setting_of,
    tuned_active_inference,
    tuned_biomimetic,
    tuned_impedance,
    tuned_mrac,
)
from makebreak.systems.baselines.active_inference import (
    ActiveInference,
    ActiveInferenceConfig,
)
from makebreak.systems.baselines.biomimetic import Biomimetic, BiomimeticConfig
from makebreak.systems.baselines.mrac import Mrac, MracConfig
from makebreak.systems.planar.planar_impedance import (
    ForceModelConfig,
    PlanarImpedance,
    PlanarImpedanceConfig,
)
from makebreak.systems.planar.planar_world import (
    CircleTargetConfig,
    PlanarWorldConfig,
    SpringConfig,
)

SPRINGS = "springs"  # The setting of the paper: only the force sensor has noise.
# Largest length at which springs of the setting "engaging" pull [m]; the circle is 0.5
# to 1 m from their anchors.
REACH = 0.7
# Nominal anchors (distance from the circle's centre [m], direction), stiffness [N/m],
# rest length [m]; the seed varies them. On the circle they pull with 7 to 40 N.
DISTANCE, DIRECTIONS = 0.75, np.radians([90.0, 210.0, 330.0])
STIFFNESS, REST_LENGTH = np.array([20.0, 40.0, 60.0]), 0.3


@dataclass
class BaselinesConfig:
    """Tuned with one budget on seeds 100 to 113 (papers/tune_planar.py)."""

    mrac: MracConfig = field(default_factory=lambda: tuned_mrac(SPRINGS))
    active_inference: ActiveInferenceConfig = field(
        default_factory=lambda: tuned_active_inference(SPRINGS)
    )
    biomimetic: BiomimeticConfig = field(
        default_factory=lambda: tuned_biomimetic(SPRINGS)
    )


@dataclass
class MultiSpringConfig:
    """Controllers left at their defaults get the values tuned for the setting."""

    seed: int = 0  # Seed of the start, the direction, the springs and the noise.
    # World and sensors: springs, springs_lab or engaging (springs that let go).
    # Controllers left at their defaults get the values tuned for it.
    setting: str = SPRINGS
    # Number of trials of the biomimetic controller, which learns over trials.
    trials: int = 30
    # Half width of the uniform draw of each spring's stiffness and distance, as a
    # fraction of the nominal value.
    spread: float = 0.2
    impedance: PlanarImpedanceConfig = field(
        default_factory=lambda: tuned_impedance(SPRINGS)[0]
    )
    model: ForceModelConfig = field(default_factory=lambda: tuned_impedance(SPRINGS)[1])
    baselines: BaselinesConfig = field(default_factory=BaselinesConfig)


def as_tuned(config: MultiSpringConfig) -> MultiSpringConfig:
    """The config with each controller at its default replaced by the tuned one."""
    c, default = config, MultiSpringConfig()
    law, model = tuned_impedance(c.setting)

    def tuned(given, default, found):
        return found if given == default else given

    b, b0 = c.baselines, default.baselines
    return replace(
        c,
        impedance=tuned(c.impedance, default.impedance, law),
        model=tuned(c.model, default.model, model),
        baselines=BaselinesConfig(
            tuned(b.mrac, b0.mrac, tuned_mrac(c.setting)),
            tuned(
                b.active_inference,
                b0.active_inference,
                tuned_active_inference(c.setting),
            ),
            tuned(b.biomimetic, b0.biomimetic, tuned_biomimetic(c.setting)),
        ),
    )


def draw(config: MultiSpringConfig) -> tuple[PlanarWorldConfig, CircleTargetConfig]:
    """World and circle of the config's seed. Raises: ValueError."""
    c = config
    if c.seed < 0:
        raise ValueError(f"seed is {c.seed}, expected 0 or more")
    if c.trials < 1:
        raise ValueError(f"trials is {c.trials}, expected 1 or more")
    if not 0.0 <= c.spread < 1.0:
        raise ValueError(f"spread is {c.spread}, expected 0 <= spread < 1")
    world = setting_of(c.setting).world
    if world == "porridge":
        raise ValueError(f'setting is "{c.setting}", which has no springs')
    return draw_springs(c.seed, c.spread, world == "engaging")


def draw_springs(
    seed: int, spread: float = 0.2, engaging: bool = False
) -> tuple[PlanarWorldConfig, CircleTargetConfig]:
    """World and circle of a seed; spread as in MultiSpringConfig.

    Args: engaging: whether springs pull only at lengths below a reach, which the seed
        draws about REACH: the force then jumps by up to 30 N.
    """
    rng = np.random.default_rng(seed)
    target = circle_of_seed(rng)
    distance = DISTANCE * (1.0 + spread * rng.uniform(-1.0, 1.0, 3))
    stiffness = STIFFNESS * (1.0 + spread * rng.uniform(-1.0, 1.0, 3))
    anchors = distance[:, None] * np.column_stack(
        [np.cos(DIRECTIONS), np.sin(DIRECTIONS)]
    )
    reach = np.full(3, np.inf)
    if engaging:
        reach = REACH * (1.0 + spread * rng.uniform(-1.0, 1.0, 3))
    springs = [
        SpringConfig(anchor, k, REST_LENGTH, most)
        for anchor, k, most in zip(
            anchors.tolist(), stiffness.tolist(), reach.tolist(), strict=True
        )
    ]
    return PlanarWorldConfig(MASS, springs=springs, period_sec=PERIOD), target


def make_multi_spring(
    config: MultiSpringConfig,
    controller: LeafSystem,
    meshcat: Meshcat | None = None,
    feedforward: bool = False,
) -> Diagram:
    """The closed loop of make_planar with a controller in the seed's world."""
    world, target = draw(config)
    sensing = setting_of(config.setting).sensing
    return make_planar(
        controller, world, target, sensing, config.seed, meshcat, feedforward
    )


def impedance(config: PlanarImpedanceConfig, model: ForceModelConfig, knowledge=None):
    """Our controller: adaptive impedance with a learned force model."""
    return PlanarImpedance(config, model, MASS, FORCE_MAX, knowledge, PERIOD)


def mrac(config: MracConfig):
    return Mrac(config, FORCE_MAX, PERIOD)


def active_inference(config: ActiveInferenceConfig):
    return ActiveInference(config, FORCE_MAX, PERIOD)


def biomimetic(config: BiomimeticConfig, knowledge=None, duration_sec: float = 6.0):
    """Args: knowledge: learned in earlier trials; duration_sec: of a trial [s]."""
    return Biomimetic(config, duration_sec, knowledge, MASS, FORCE_MAX, PERIOD)
