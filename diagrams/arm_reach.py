"""Which joint positions bring the arm's tip to a pose, and whether the arm can follow a
motion pattern at all: its reach, the limits of its joints, and their speeds.

Source: damped Gauss-Newton with a null-space term; Siciliano et al., Robotics, 3.7.
"""

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable

from makebreak.diagrams.scene_facts import PANDA_JOINTS
from makebreak.diagrams.station import ARM, TIP_FRAME
from makebreak.systems.changing_contact.numerics.motion_pattern import MotionPattern

NEAR_M, NEAR_RAD = 1e-3, 0.01  # Errors of the tip within which a pose is reached.
STEPS = 30  # Limit of Gauss-Newton steps.
SAMPLE_SEC = 0.02  # Between the poses of a pattern that are checked.
SAMPLES_MIN, SAMPLES_MAX = 50, 1500  # Number of these poses.


class ArmReach:
    """Inverse kinematics of a control plant's arm, with its own Context.

    Args: arm: a plant with only the Panda and its tool.
    """

    def __init__(self, arm: MultibodyPlant):
        self._arm, self._context = arm, arm.CreateDefaultContext()
        self._world, self._tip = arm.world_frame(), arm.GetFrameByName(TIP_FRAME)
        self.q_default = arm.GetPositions(self._context)
        self.R_default = self._tip.CalcRotationMatrixInWorld(self._context)

    def pose(self, q) -> tuple[np.ndarray, RotationMatrix]:
        """p_WE (3,) [m] and R_WE of the tip at joint positions q (7,) [rad]."""
        self._arm.SetPositions(self._context, q)
        X = self._tip.CalcPoseInWorld(self._context)
        return X.translation(), X.rotation()

    def jacobian(self, q) -> np.ndarray:
        """(6, 7) Jacobian of the tip's angular and linear velocity, world axes."""
        self._arm.SetPositions(self._context, q)
        return self._arm.CalcJacobianSpatialVelocity(
            self._context, JacobianWrtVariable.kV, self._tip, np.zeros(3),
            self._world, self._world,
        )  # fmt: skip

    def mass_matrix(self, q) -> np.ndarray:
        """(7, 7) mass matrix of the arm at joint positions q (7,)."""
        self._arm.SetPositions(self._context, q)
        return self._arm.CalcMassMatrix(self._context)

    def _error(self, q, p, R) -> np.ndarray:
        """(6,) rotation vector [rad] and translation [m] from the tip at q to p, R."""
        p_now, R_now = self.pose(q)
        turn = (R @ R_now.inverse()).ToAngleAxis()
        return np.r_[turn.angle() * turn.axis(), p - p_now]

    def positions(self, p, R: RotationMatrix, q_near) -> np.ndarray:
        """Joint positions (7,) [rad] that bring the tip to p (3,) [m] and R, or near a
        pose out of reach, as close to q_near (7,) as possible."""
        q = np.array(q_near, dtype=float)
        for _ in range(STEPS):
            J = self.jacobian(q)
            inverse = J.T @ np.linalg.inv(J @ J.T + 1e-4 * np.eye(6))
            back = q_near - q
            # In the null space it moves back to q_near.
            step = inverse @ (self._error(q, p, R) - J @ back) + back
            q = q + step
            if np.linalg.norm(step) < 1e-4:
                break
        return q

    def misses(self, q, p, R: RotationMatrix) -> tuple[float, float]:
        """Distance [m] and angle [rad] of the tip at q to a pose."""
        error = self._error(q, p, R)
        return float(np.linalg.norm(error[3:])), float(np.linalg.norm(error[:3]))


def joint_positions_along(pattern: MotionPattern, arm: MultibodyPlant) -> np.ndarray:
    """Joint positions (n, 7) [rad] of the arm along a pattern, from its first pose on.

    Raises: ValueError with segment, time, and the pose, joint limit or speed that the
        arm cannot achieve.
    """
    reach = ArmReach(arm)
    joints = [
        arm.GetJointByName(name, arm.GetModelInstanceByName(ARM))
        for name in PANDA_JOINTS
    ]
    lower = np.array([j.position_lower_limits()[0] for j in joints])
    upper = np.array([j.position_upper_limits()[0] for j in joints])
    speed_max = np.array([j.velocity_upper_limits()[0] for j in joints])
    start, ends = pattern.segments[0].times[0], [s.times[1] for s in pattern.segments]
    n = int(np.clip(pattern.duration / SAMPLE_SEC, SAMPLES_MIN, SAMPLES_MAX)) + 1
    times = np.linspace(start, ends[-1], n)

    q, found = reach.q_default, []
    p_now, _ = reach.pose(q)
    first = pattern.pose(start)
    for s in np.linspace(0.1, 1.0, 10):  # From the default to the first pose.
        p = p_now + s * (first[:3] - p_now)
        R = _rotation(first[3:7])
        q = reach.positions(p, R, q)
    # Reported last, as joints are also fast shortly before a pose is out of reach.
    k_before, too_fast = -1, ""
    for t in times:
        pose = pattern.pose(t)
        R = _rotation(pose[3:7])
        q_next = reach.positions(pose[:3], R, q)
        k = min(int(np.searchsorted(ends, t, side="left")), len(ends) - 1)
        where = f"segment {k} at {t:.2f} s"
        gap, turn = reach.misses(q_next, pose[:3], R)
        if gap > NEAR_M or turn > NEAR_RAD:
            at = ", ".join(f"{x:.3f}" for x in pose[:3])
            raise ValueError(
                f"{where}: the arm cannot reach ({at}) m, the tip stays "
                f"{1e3 * gap:.0f} mm and {np.rad2deg(turn):.0f} degrees away, expected "
                "poses within its reach"
            )
        for name, x, low, high in zip(PANDA_JOINTS, q_next, lower, upper, strict=True):
            if not low <= x <= high:
                raise ValueError(
                    f"{where}: {name} would be at {x:.2f} rad, expected {low:.2f} to "
                    f"{high:.2f} rad"
                )
        if k == k_before:  # Between segments, contacts determine the tip's place.
            speed = abs(q_next - q) / (times[1] - times[0])
            j = int(np.argmax(speed / speed_max))
            if speed[j] > speed_max[j]:
                too_fast = too_fast or (
                    f"{where}: too fast, {PANDA_JOINTS[j]} would turn at "
                    f"{speed[j]:.2f} rad/s, expected at most {speed_max[j]:.2f} rad/s"
                )
        found.append(q_next)
        q, k_before = q_next, k
    if too_fast:
        raise ValueError(too_fast)
    return np.array(found)


def _rotation(wxyz) -> RotationMatrix:
    return RotationMatrix(Quaternion(wxyz / np.linalg.norm(wxyz)))
