"""The arm: from a planner's output to joint torques.

arm_reference         C3's next state as a pose that the arm can follow, and a force
impedance_controller  torques for a desired stiffness, damping and force
variable_impedance    stiffness and feed-forward from the forward model's prediction
force_feedforward     a predicted force cancelled along the motion
tool_wrench           force-torque sensor between flange and tool
wrench_tare           the sensor's bias, found in free space and taken off
surface_alignment     the tool laid flat on what it is pressed on
tip_state             pose and velocity of the tip
gravity_left_out      torques for a robot that compensates gravity itself
"""
