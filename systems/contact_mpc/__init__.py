"""Contact-implicit MPC: a linear complementarity model of any plant, plans through it.

lcs_builder       the LCS of a plant about a state
lcs_plant         an LCS as a world
c3_mpc            C3, C3+: plans through contact
residual_learner  what the LCS has wrong, learned while the robot works
contact_sampler   where to touch an object that is to be pushed
rolling_task, push_goals, push_task, pivot_target: what C3 is to do next
"""
