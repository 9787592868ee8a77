"""The systems: LeafSystems that meet at ports, in wings by subject.

contact_mpc/       a contact model of any plant (LCS), plans through contact (C3), what
                   the model has wrong (residual), where to touch, the tasks
changing_contact/  contacts felt and expected, contact modes and their forward models,
                   motions slowed down before a contact and blended after it
arm/               from what a planner wants to torques: references, impedance, tool
perception/        cameras and noisy sensors, trackers, the state that planners use
planar/            a point in the plane with adaptive impedance
baselines/         what ours is compared with
faults/            faults injected into signals, pictures and forces, and the monitor
views/             what is seen and pressed in Meshcat, and ground truth for scores

Each file has one LeafSystem and its config. Its maths is in the wing's numerics/, most
often under the same name; numerics/ here is what all share. Systems never import each
other. Maths of a wing does, of some wings and one way: MATHS_OF in tests/test_code.py.
"""

import sys

from makebreak.systems.moved import FormerNames

if not any(isinstance(finder, FormerNames) for finder in sys.meta_path):
    sys.meta_path.insert(0, FormerNames())
