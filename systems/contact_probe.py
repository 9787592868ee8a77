"""Ground truth of one contact, for scoring."""

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.multibody.plant import ContactResults
from pydrake.multibody.tree import RigidBody
from pydrake.systems.framework import BasicVector, Context, LeafSystem


class ContactProbe(LeafSystem):
    """The force between two bodies (point contact), found when it is asked for.

    Inputs:  contact_results (abstract).
    Outputs: contact_force (4,) = [normal force, force on the second body xyz in the
             world] [N]; zeros while they do not touch.
    """

    def __init__(self, first: RigidBody, second: RigidBody):
        super().__init__()
        self._first, self._second = int(first.index()), int(second.index())
        self._results = self.DeclareAbstractInputPort(
            "contact_results", AbstractValue.Make(ContactResults())
        )
        self.DeclareVectorOutputPort("contact_force", 4, self._calc)

    def _calc(self, context: Context, output: BasicVector):
        force = np.zeros(4)
        results = self._results.Eval(context)
        for i in range(results.num_point_pair_contacts()):
            contact = results.point_pair_contact_info(i)
            a, b = int(contact.bodyA_index()), int(contact.bodyB_index())
            if (a, b) == (self._first, self._second):
                sign = 1.0  # Drake's force acts on B.
            elif (b, a) == (self._first, self._second):
                sign = -1.0
            else:
                continue
            f_B = contact.contact_force()
            force[0] += abs(f_B @ contact.point_pair().nhat_BA_W)
            force[1:] += sign * f_B
        output.SetFromVector(force)
