"""Time of an update of the residual learner; the target is 5 ms for n_b = 10."""

from time import process_time

import numpy as np

from makebreak.systems.contact_mpc.numerics.lcs import LCS, simulate
from makebreak.systems.contact_mpc.numerics.residual_learner import (
    empty_buffer,
    gamma_bound,
    group_of_entry,
    learn,
    measured_step,
    zero_residual,
)

EPS, GAMMA, DT = 2e-6, 5e-4, 0.05


def finger_and_ball(rng) -> tuple[LCS, LCS]:
    """Model and truth of a finger on a ball on a table, of ball_rolling's dimensions.

    15 states, 3 inputs, two contacts of 4 friction edges; masses and lever arms are
    those of the ball-rolling scene, and contacts are open or closed at random.
    """
    normal = np.repeat([[1.0, 0, 0], [0, 0, 1.0]], 4, axis=0)
    tangents = np.array([[0, 1, 0], [0, 0, 1], [0, -1, 0], [0, 0, -1]])
    push = normal + np.vstack([tangents, np.roll(tangents, 1, axis=1)])
    arm = 0.0315 * np.cross(-normal, push)
    J_e = np.vstack([-push[:4], np.zeros((4, 3))])
    J_v = np.hstack([J_e, arm, push])  # v = [v_e, omega, v_b].
    inverse_mass = np.repeat([1.0, 1 / (0.4 * 0.07 * 0.0315**2), 1 / 0.07], 3)
    D_v = DT * inverse_mass[:, None] * J_v.T
    pick = np.zeros((9, 6))  # Rates of the positions of finger and ball.
    pick[[0, 1, 2, 6, 7, 8], range(6)] = 1.0
    A = np.block([[np.eye(6), DT * pick.T], [np.zeros((9, 6)), np.eye(9)]])
    D = np.vstack([DT * pick.T @ D_v, D_v])
    B_v = np.vstack([DT * np.eye(3), np.zeros((6, 3))])
    B = np.vstack([DT * pick.T @ B_v, B_v])
    J_n = np.hstack([-normal[:4], normal[:4]])
    J_n = np.vstack([J_n, np.hstack([np.zeros((4, 3)), normal[4:]])])
    E = np.hstack([J_n / DT, J_v])
    F = J_v @ D_v + 0.01 * DT * np.eye(8)
    gap = np.repeat(rng.uniform(-0.1, 0.1, size=2), 4)
    model = LCS(A, B, D, np.zeros(15), E, F, J_v @ B_v, gap, DT)
    return model, model.with_residual(np.repeat([-0.1, 0.0], 4))


def rows(n_b: int = 10, repetitions: int = 200) -> list[dict]:
    """CPU time of a whole update: a new pair, its QP terms, and the Adam steps."""
    rng = np.random.default_rng(0)
    Q_d = np.zeros(15)
    Q_d[[8, 12, 13]] = 1e5
    found = []
    for n_steps in (1, 5):
        buffer, residual = empty_buffer(8), zero_residual(1)
        group = group_of_entry([[0, 1, 2, 3]], 8)
        seconds = []
        for _ in range(n_b + repetitions):
            model, truth = finger_and_ball(rng)
            x, u = 0.01 * rng.normal(size=15), rng.normal(size=3)
            x_next = simulate(truth, x, u)[0] + 1e-3 * rng.normal(size=15)
            start = process_time()
            assert GAMMA < gamma_bound(model.F)
            step = measured_step(model, x, u, x_next, Q_d, EPS)
            buffer = buffer.append(step, n_b)
            residual, _, solved = learn(
                buffer,
                residual,
                group,
                eps=EPS,
                gamma=GAMMA,
                learning_rate=3e-3,
                n_steps=n_steps,
                r_max=1.0,
            )
            seconds.append(process_time() - start)
            if not solved:
                raise RuntimeError("bench_learner: a QP was not solved")
        ms = 1e3 * float(np.median(seconds[n_b:]))
        found.append(
            {
                "what": f"residual update, n_b {n_b}, n_lam 8, Adam steps {n_steps}",
                "value": ms,
                "unit": "ms",
                "met": ms <= 5.0,
            }
        )
    return found


if __name__ == "__main__":
    for row in rows():
        print(f"{row['what']}: {row['value']:.3f} {row['unit']} CPU")
