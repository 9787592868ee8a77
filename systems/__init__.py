"""The systems, in the order in which data flows.

Sensing and estimation   pinhole_camera, camera_shake, noisy_sensor, tool_wrench,
                         ball_tracker, state_estimator
Modelling                lcs_builder
Adaptation               residual_learner; baselines/dynamics_residual_learner
Planning                 rolling_task, c3_mpc
Control                  arm_reference, impedance_controller
For scoring and the eye  contact_probe, rolling_view, walls_view
As a world               lcs_plant

Each file has one LeafSystem and its config; its maths is in numerics/, under the same
name. Systems do not import each other: they meet at ports.
"""
