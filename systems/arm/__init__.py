"""The arm: from what a planner wants to torques.

arm_reference         C3's next state as a pose that the arm can follow, and a force
impedance_controller  torques for a wanted stiffness, damping and force
variable_impedance    stiffness and feed-forward from what the forward model predicts
tool_wrench           what the tool feels
tip_state             where the tip is, and how it moves
gravity_left_out      for a robot that carries its own weight
"""
