"""A circle in the plane through porridge that thickens (CC 4.1, Fig. 4; 4.2.1)."""

from dataclasses import dataclass, field

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Diagram, LeafSystem

from makebreak.diagrams.planar import (
    MASS,
    PERIOD,
    PlanarSensing,
    circle_of_seed,
    make_planar,
)
from makebreak.diagrams.planar_tuned import tuned_mrac
from makebreak.systems.baselines.mrac import MracConfig
from makebreak.systems.changing_contact.numerics.igmm import IgmmConfig
from makebreak.systems.planar.planar_impedance import (
    ForceModelConfig,
    PlanarImpedanceConfig,
)
from makebreak.systems.planar.planar_world import CircleTargetConfig, PlanarWorldConfig


def _impedance() -> PlanarImpedanceConfig:
    """The control law as tuned on springs (docs/planar.md)."""
    return PlanarImpedanceConfig(
        stiffness_free=110.0, damping_ratio=2.0, steepness=11.9, error_mid=1.78
    )


def _model() -> ForceModelConfig:
    """The best of a few settings of the mixture that were tried (docs/planar.md)."""
    mixture = IgmmConfig(sigma_ini=[0.05, 1.0, 1.0], sp_max=55.7)
    return ForceModelConfig(mixture, along_motion=True)


@dataclass
class PorridgeConfig:
    """Settings of `makebreak run porridge`."""

    # Seed of the start, the direction, the final viscosity of the test and the noise.
    seed: int = 0
    # Final viscosity in training and in the test; it rises from 0 [N s/m].
    viscosity: list[float] = field(default_factory=lambda: [80.0, 150.0])
    # Half width of the uniform draw of the test's final viscosity, as a fraction of it.
    spread: float = 0.2
    # Standard deviation of the force sensor's noise along each axis [N].
    force_noise: float = 0.2
    impedance: PlanarImpedanceConfig = field(default_factory=_impedance)
    model: ForceModelConfig = field(default_factory=_model)
    # Tuned on seeds 100 to 113 (papers/tune_planar.py, docs/planar.md).
    mrac: MracConfig = field(default_factory=lambda: tuned_mrac("porridge"))


def draw(
    config: PorridgeConfig, training: bool
) -> tuple[PlanarWorldConfig, CircleTargetConfig, int]:
    """World, circle and the noise's seed, for training or test. Raises: ValueError."""
    c = config
    if c.seed < 0:
        raise ValueError(f"seed is {c.seed}, expected 0 or more")
    viscosity = np.array(c.viscosity, dtype=float)
    if viscosity.shape != (2,) or not 0.0 <= viscosity[0] < viscosity[1] < np.inf:
        raise ValueError(
            f"viscosity is {c.viscosity}, expected 2 numbers, the second larger"
        )
    if not 0.0 <= c.spread < 1.0:
        raise ValueError(f"spread is {c.spread}, expected 0 <= spread < 1")
    if not 0.0 <= c.force_noise < np.inf:
        raise ValueError(f"force_noise is {c.force_noise}, expected >= 0")
    rng = np.random.default_rng(c.seed)
    target = circle_of_seed(rng)
    tested = viscosity[1] * (1.0 + c.spread * rng.uniform(-1.0, 1.0))
    world = PlanarWorldConfig(
        mass=MASS,
        viscosity=[0.0, float(viscosity[0] if training else tested)],
        ramp_sec=target.duration_sec,
        period_sec=PERIOD,
    )
    return world, target, 2 * c.seed + int(training)


def make_porridge(
    config: PorridgeConfig,
    controller: LeafSystem,
    training: bool = False,
    meshcat: Meshcat | None = None,
) -> Diagram:
    """The closed loop of make_planar with a controller in the seed's porridge."""
    world, target, noise_seed = draw(config, training)
    sensing = PlanarSensing(force_noise=config.force_noise)
    return make_planar(controller, world, target, sensing, noise_seed, meshcat)
