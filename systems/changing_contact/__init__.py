"""Contacts that change: felt, expected, told apart, met gently.

contact_detector     contacts made, broken, and their peak force
mode_detector        contact modes, and new ones
forward_model        the force to come, one model a mode
contact_anticipator  where contacts are expected, and how fast to meet them
velocity_shaper      a motion re-timed to do so, without a jerk
impact_reflex        gives way at a touch
moving_frame, push_motion, reference_blend: the same beside an object that moves
"""
