"""The systems, in the order in which data flows.

Sensing and estimation   pinhole_camera, camera_shake, noisy_sensor, tool_wrench,
                         ball_tracker, pose_tracker, pose_sensor, past_state,
                         state_estimator, tip_state, contact_detector,
                         mode_detector, contact_anticipator
Modelling                lcs_builder, forward_model
Adaptation               residual_learner
Planning                 rolling_task, push_goals, push_task, contact_sampler,
                         pivot_target, c3_mpc
Shaping                  velocity_shaper, variable_impedance
Control                  arm_reference, impedance_controller, impact_reflex,
                         gravity_left_out
For scoring and the eye  contact_probe, rolling_view, walls_view, contact_view,
                         push_view
Faults, and who watches  fault_signals, fault_pictures, fault_forces, safety_monitor
As a world               lcs_plant
In the plane             planar_world, planar_impedance, planar_view
Compared with            baselines/: dynamics_residual_learner, mrac, active_inference,
                         biomimetic, long_term_predictor

Each file has one LeafSystem and its config; its maths is in numerics/, under the same
name. Systems do not import each other: they meet at ports.
"""
