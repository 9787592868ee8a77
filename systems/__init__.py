"""LeafSystems, in packages by subject. They are connected at ports only.

contact_mpc/       contact models of any plant (LCS), MPC through contact (C3), residual
                   learning, contact sampling, and the tasks of the controller
changing_contact/  contact detection and anticipation, contact modes and their forward
                   models, slowing down before contacts and blending after them
arm/               from planned references to joint torques: impedance control, tool
perception/        cameras and noisy sensors, trackers, state estimators
planar/            adaptive impedance control of a point in the plane
baselines/         methods of other authors, for comparison
faults/            faults injected into signals, images and forces; safety monitor
views/             displays and buttons in Meshcat, and ground truth for evaluation

Each file has one LeafSystem and its config. Its maths is in the package's numerics/,
usually under the same name; what all packages share is in systems/numerics/.
contact_mpc/multibody/ asks a MultibodyPlant and is no system. Systems never import each
other. Which packages may use whose numerics is in MATHS_OF in tests/test_code.py.
"""

from makebreak.systems.numerics import code_cache as code_cache
