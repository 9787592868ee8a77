"""True contact forces, for scoring only."""

import math
from collections.abc import Iterable

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.multibody.plant import ContactResults
from pydrake.multibody.tree import RigidBody
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from makebreak.systems.arm.numerics.contact_force import tip_wrench
from makebreak.systems.arm.numerics.packed import packed
from makebreak.systems.arm.numerics.serial_chain import SerialChain
from makebreak.systems.arm.numerics.tip_state import tip_pose
from makebreak.systems.numerics.first_calls import first_call


class ContactProbe(LeafSystem):
    """Contact forces between a body and n others (point contact), computed when
    evaluated.

    Inputs:  contact_results (abstract).
    Outputs: contact_force (4 n,): for each of the others [normal force, force on it xyz
             in the world] [N]; zeros while they do not touch.
    """

    def __init__(self, first: RigidBody, *others: RigidBody):
        super().__init__()
        self._first = int(first.index())
        self._row = {int(body.index()): i for i, body in enumerate(others)}
        self._results = self.DeclareAbstractInputPort(
            "contact_results", AbstractValue.Make(ContactResults())
        )
        self.DeclareVectorOutputPort("contact_force", 4 * len(others), self._calc)

    def _calc(self, context: Context, output: BasicVector):
        force = np.zeros((len(self._row), 4))
        results = self._results.Eval(context)
        for i in range(results.num_point_pair_contacts()):
            contact = results.point_pair_contact_info(i)
            a, b = int(contact.bodyA_index()), int(contact.bodyB_index())
            if a == self._first and b in self._row:
                row, sign = self._row[b], 1.0  # Drake's force acts on B.
            elif b == self._first and a in self._row:
                row, sign = self._row[a], -1.0
            else:
                continue
            f_B = contact.contact_force()
            force[row, 0] += abs(f_B @ contact.point_pair().nhat_BA_W)
            force[row, 1:] += sign * f_B
        output.SetFromVector(force.ravel())


class ContactLoad(LeafSystem):
    """Sum of the magnitudes of all contact forces on some bodies, such as an arm and
    its tool (point contact). Opposing forces do not cancel; contacts among the bodies
    themselves are ignored.

    Inputs:  contact_results (abstract); contact_torque (n,), optional: of all contacts
             on the bodies' joints [N m]. Where it is zero, contact results are not read
             (Drake copies them all), so contacts of what no joint moves, such as an
             arm's base, count only beside others.
    Outputs: load (2,): from the body `other`, and from everything else [N].

    Args: bodies; other: the body whose contacts are summed separately; size: n.
    """

    def __init__(self, bodies: Iterable[RigidBody], other: RigidBody, size: int = 0):
        super().__init__()
        self._torque = self.DeclareVectorInputPort("contact_torque", size)
        self._bodies = frozenset(int(body.index()) for body in bodies)
        self._other = int(other.index())
        self._results = self.DeclareAbstractInputPort(
            "contact_results", AbstractValue.Make(ContactResults())
        )
        self.DeclareVectorOutputPort("load", 2, self._calc)

    def _calc(self, context: Context, output: BasicVector):
        load = np.zeros(2)
        read = self._torque.HasValue(context)
        if read and not np.count_nonzero(self._torque.Eval(context)):
            output.SetFromVector(load)
            return
        results = self._results.Eval(context)
        for i in range(results.num_point_pair_contacts()):
            contact = results.point_pair_contact_info(i)
            a, b = int(contact.bodyA_index()), int(contact.bodyB_index())
            if (a in self._bodies) == (b in self._bodies):
                continue
            outside = b if a in self._bodies else a
            row = 0 if outside == self._other else 1
            force = contact.contact_force()
            load[row] += math.sqrt(force @ force)
        output.SetFromVector(load)


class TrueTip(LeafSystem):
    """The true position of the tip.

    Inputs:  state (2 n,) of the arm.
    Outputs: tip_position (3,) in the world [m].

    Args: chain: of the arm with its tool in the world.
    """

    def __init__(self, chain: SerialChain):
        super().__init__()
        self._chain = packed(chain)
        self._n = len(chain.mass)
        first_call(tip_pose, self._chain, np.zeros(self._n))
        self._state = self.DeclareVectorInputPort("state", 2 * self._n)
        self.DeclareVectorOutputPort("tip_position", 3, self._calc)

    def _calc(self, context: Context, output: BasicVector):
        q = self._state.Eval(context)[: self._n]
        output.SetFromVector(tip_pose(self._chain, q)[:3])


class ToolContactForce(LeafSystem):
    """The force of all contacts on the tool, computed when evaluated.

    It is computed from the joint torques of the contacts: copying Drake's contact
    results would take longer than a step of the plant. Contacts of the arm's links
    contribute to it too.

    Inputs:  state (2 n,) of the arm; contact_torque (n,): of all contacts [N m].
    Outputs: contact_force (3,): on the tool in the world [N].

    Args: chain: of the arm with its tool.
    """

    def __init__(self, chain: SerialChain):
        super().__init__()
        self._chain = packed(chain)
        self._n = len(chain.mass)
        first_call(tip_wrench, self._chain, np.zeros(self._n), np.zeros(self._n))
        self._state = self.DeclareVectorInputPort("state", 2 * self._n)
        self._torque = self.DeclareVectorInputPort("contact_torque", self._n)
        self.DeclareVectorOutputPort("contact_force", 3, self._calc)

    def _calc(self, context: Context, output: BasicVector):
        q = self._state.Eval(context)[: self._n]
        wrench = tip_wrench(self._chain, q, self._torque.Eval(context))
        output.SetFromVector(wrench[:3])
