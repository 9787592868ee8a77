"""Contact-implicit MPC: linear complementarity models (LCS) of plants, and C3 on them.

lcs_builder       the LCS of any MultibodyPlant about its state (computed in multibody/)
lcs_plant         an LCS as the simulated plant
c3_mpc            C3 and C3+: MPC through contact
residual_learner  online learning of the LCS's contact residual
contact_sampler   choice of the point at which to touch an object that is to be pushed
rolling_task, push_goals, push_task, pivot_target: the reference of C3
"""
