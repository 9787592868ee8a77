"""Former names of modules: makebreak.systems.c3_mpc is now
makebreak.systems.contact_mpc.c3_mpc, and so on. Code of users, such as exported tests,
may still import the former names."""

import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_loader
from types import ModuleType

# {package: its modules that were in systems/}; _NUMERICS: in systems/numerics/.
_SYSTEMS = {
    "contact_mpc": (
        "c3_mpc contact_sampler lcs_builder lcs_plant pivot_target push_goals "
        "push_task residual_learner rolling_task"
    ),
    "changing_contact": (
        "contact_anticipator contact_detector forward_model impact_reflex "
        "mode_detector moving_frame push_motion reference_blend velocity_shaper"
    ),
    "arm": (
        "arm_reference gravity_left_out impedance_controller tip_state tool_wrench "
        "variable_impedance"
    ),
    "perception": (
        "ball_tracker camera_shake noisy_sensor past_state pinhole_camera pose_sensor "
        "pose_tracker state_estimator"
    ),
    "planar": "planar_impedance planar_world",
    "baselines": "frozen",
    "views": (
        "adapt_button contact_probe contact_view planar_view push_view rolling_view "
        "walls_view"
    ),
    "faults": "fault_forces fault_pictures fault_signals safety_monitor",
}
_NUMERICS = {
    "contact_mpc": (
        "ball_state c3_mpc c3_polish c3_projections c3_qp cartpole contact_sampling "
        "convex_hull lcp lcs lcs_builder nearest_point orientation_cost pivot_target "
        "push_task residual_learner residual_posterior rolling_task"
    ),
    "changing_contact": (
        "contact_anticipator contact_detector contact_task forward_model igmm "
        "impact_reflex impact_score mode_detector mode_table motion_feature "
        "motion_pattern path_geometry push_motion reference_blend velocity_profile "
        "velocity_shaper"
    ),
    "arm": (
        "arm_reference cholesky contact_force impedance_controller packed serial_chain "
        "tip_state tool_wrench variable_impedance"
    ),
    "perception": (
        "ball_tracker constant_velocity interacting_models past_state pinhole "
        "pose_filter pose_tracker sensor_noise state_estimator"
    ),
    "planar": "planar_impedance planar_world",
    "baselines": "active_inference biomimetic dynamics_residual fixed_gmm mrac",
    "faults": "time_span",
}
MOVED = {
    f"{__package__}{room}.{name}": f"{__package__}.{wing}{room}.{name}"
    for room, modules in (("", _SYSTEMS), (".numerics", _NUMERICS))
    for wing, names in modules.items()
    for name in names.split()
}
MOVED |= {
    f"{__package__}.numerics.baselines": f"{__package__}.baselines.numerics",
    f"{__package__}.numerics.baselines.long_term_predictor": (
        f"{__package__}.baselines.numerics.long_term_predictor"
    ),
}


class FormerNames(MetaPathFinder, Loader):
    """Imports the present module for a former name, so that there is only one copy of
    it. It must be first in sys.meta_path: another finder would load a second copy."""

    def find_spec(
        self,
        fullname: str,
        path: Sequence[str] | None = None,
        target: ModuleType | None = None,
    ) -> ModuleSpec | None:
        return spec_from_loader(fullname, self) if fullname in MOVED else None

    def exec_module(self, module: ModuleType) -> None:
        sys.modules[module.__name__] = import_module(MOVED[module.__name__])
