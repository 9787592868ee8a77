"""The LCS of a MultibodyPlant: what asks a plant and its scene graph, and is no system.

contact_pair      which bodies or geometries may touch, with what friction and model
contact_layout    the contacts of an LCS and their rows: the order of the forces lam
witness_points    distances, normals and witness points; the contact Jacobian
smooth_dynamics   acceleration without contact, its derivatives, mass matrix, N and N+
constant_mass     whether the fast path applies to a plant, and its data
anitescu_lcs      the LCS of a plant about any state, from all of these
"""
