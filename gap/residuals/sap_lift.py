"""What the solver SAP makes of friction, and real contacts do not.

SAP takes the depth of what slides at v for larger by mu (tau + dt) v: it is lifted, and
what is curved drags more than its friction, by about tau v / R. tau is the sum of both
surfaces' relaxation times, of which Drake takes 0.1 s each where none is set.

Source: Castro, Permenter, Han, An Unconstrained Convex Formulation of Compliant
Contact, IEEE Trans. Robotics 38(6), 2022, section V.
"""

import numpy as np

from makebreak.gap.data.findings import Finding
from makebreak.gap.numerics.permitted_forces import tangential
from makebreak.gap.residuals.contact_dynamics import ContactDynamics

DEFAULT = 0.1  # [s] Relaxation time of a surface that has none.
FAST = 95.0  # Percentile of the speed of slip.


def sap_lift(contacts: ContactDynamics) -> list[Finding]:
    """A warning where the scene's own simulation lifts what slides by more than its
    shapes are known to; none with other solvers."""
    plant = contacts.scene.plant
    if plant.discrete_contact_approximation != "sap" or not plant.time_step:
        return []
    inspector = contacts.dynamics.loaded.scene_graph.model_inspector()

    def relaxation(geometry) -> float:
        properties = inspector.GetProximityProperties(geometry)
        return float(
            properties.GetPropertyOrDefault("material", "relaxation_time", DEFAULT)
        )

    worst = (0.0, 0.0, "")
    for s, on in zip(contacts.slots, contacts._masks, strict=True):
        point, surface = s.key
        if not on.any() or point < 0:  # Edges that cross slide little.
            continue
        tau = relaxation(contacts.shapes.points[point].geometry)
        tau += relaxation(contacts.shapes.surfaces[surface].geometry)
        v = np.einsum("nij,nj->ni", contacts._relative(s), contacts._node_v)[on]
        slip = np.linalg.norm(tangential(v, s.normal[on]), axis=1)
        fast = float(np.percentile(slip, FAST))
        lift = s.friction * (tau + plant.time_step) * fast
        worst = max(worst, (lift, tau, contacts.pair_name(contacts._pair_of(s))))
    lift, tau, pair = worst
    if lift <= contacts.shape_std():
        return []
    says = (
        f"The scene is simulated with SAP, which takes what slides at {pair} for "
        f"{1e3 * lift:.2g} mm deeper than it is (relaxation times of {tau:.2g} s "
        "together, 0.1 s for each surface that sets none): it is lifted, and drags "
        "more than its friction says. Real contacts do not, and a recording of such a "
        "simulation will not agree with Coulomb's law. Set `relaxation_time` (about "
        "the dissipation in s/m times the depth), or take the approximation `lagged`."
    )
    recording = contacts.recordings[0].name
    return [Finding("sap_lift", recording, pair, lift, "m", "warning", says)]
