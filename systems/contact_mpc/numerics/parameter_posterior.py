"""A Gaussian belief of physical parameters, from one measured step after another.

The violation-based loss l_k of a measured step (residual_learner.py), with weights that
are inverse variances, is a negative log-likelihood of the parameters: the contact
forces are latent, chosen for the parameters by the loss itself. The belief N(m, L^-1)
of the scaled parameters z (zero: the model's value; one: its standard deviation) goes
to the minimum of

    1/2 (z - m)' L (z - m) + trust l_k(z)

by damped Gauss-Newton steps: an iterated extended Kalman filter in information form,
so that what no step tells stays at the model's value, with the model's deviation.

With rows a(z, lam) of the prediction and of the closed contacts, the forces that are
free are eliminated: only the part of da/dz that no change of these forces explains
tells of z (variable projection, Golub and Pereyra, SIAM J. Numerical Analysis 10
(1973); Kaufman, BIT 15 (1975)). Of a contact that certainly slides only the size of the
force is free: it is on the boundary of the cone, against the slip (`acting`).

Source: the loss, ACI-MPC section VI; the filter: Bell, Cathey, IEEE Trans. Automatic
Control 38 (1993).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from makebreak.systems.contact_mpc.numerics.contact_rows import friction_edges
from makebreak.systems.contact_mpc.numerics.lcs import LCS
from makebreak.systems.contact_mpc.numerics.residual_learner import (
    gamma_bound,
    solve_step,
)

NEWTON_STEPS = 4  # Of one update, at most.
HALVINGS = 4  # Of a Gauss-Newton step that does not lower the cost.
BEYOND_NOISE = 2.0  # Deviations.
SMALL = 1e-2  # A change of z that ends the update.
ROUNDING = 1e-6  # Of what a deviation of z changes, in deviations of a step's errors.


@dataclass(frozen=True, eq=False)
class Belief:
    """Of the scaled parameters z: mean (n,) and information (n, n)."""

    mean: np.ndarray
    information: np.ndarray

    def __post_init__(self):
        self.mean.setflags(write=False)
        self.information.setflags(write=False)

    def __deepcopy__(self, memo):
        return self  # Nothing in it can change.

    @property
    def std(self) -> np.ndarray:
        """(n,) standard deviations."""
        return np.sqrt(np.diag(np.linalg.inv(self.information)))


def prior(n: int) -> Belief:
    """What the model says: zero, with a deviation of one."""
    return Belief(np.zeros(n), np.eye(n))


@dataclass(frozen=True, eq=False)
class Scale:
    """z of physical values: nominal exp(std z) where is_log, else nominal + std z."""

    nominal: np.ndarray  # (n,)
    std: np.ndarray  # (n,)
    is_log: np.ndarray  # (n,) bool

    def values(self, z) -> np.ndarray:
        grown = self.nominal * np.exp(np.where(self.is_log, self.std * z, 0.0))
        return np.where(self.is_log, grown, self.nominal + self.std * z)

    def slopes(self, values) -> np.ndarray:
        """(n,) derivative of the values in z."""
        return np.where(self.is_log, values, 1.0) * self.std


@dataclass(frozen=True, eq=False)
class Sample:
    """One measured step: from x_now (n_x,) under the mean input u (n_u,) to x_next, of
    whose entries the last n_v are velocities.

    Its LCS is built about the state half-way, x: forces and accelerations there are
    those of the step to second order in dt (about x_now: to first order, which takes
    an arm's own motion for a mass).
    """

    x_now: np.ndarray
    u: np.ndarray
    x_next: np.ndarray
    v_mean: np.ndarray  # (n_v,) velocity that the change of the positions was.
    M: np.ndarray  # (n_v, n_v) mass matrix half-way.

    @property
    def x(self) -> np.ndarray:
        """(n_x,) half-way; its velocity is the mean of the step, whose damping is then
        exact also where an impact is in it."""
        x = 0.5 * (self.x_now + self.x_next)
        x[-self.v_mean.size :] = self.v_mean
        return x


@dataclass(frozen=True, eq=False)
class Acting:
    """What the forces of a step can be: lam = ways f, with m numbers f >= 0 [N].

    Of a contact that slides one way, of another one its edges. ways (n_lam, m); rows
    (n_lam, m): rows' w is the gap velocity of each way, of its contact's normal; slides
    (n_lam,) bool; errors (2, n_lam, m): deviations of lam over f, across the slip and
    along it.
    """

    ways: np.ndarray
    rows: np.ndarray
    slides: np.ndarray
    errors: np.ndarray


@dataclass(frozen=True)
class Loss:
    """W (n_x, n_x) inverse covariance of the one-step errors; eps, gamma as in
    residual_learner.py; acting; None: no contact slides. of_model (n_v, n_v): part of
    the velocities' errors that is the model's, and not the sensors'; None: nothing."""

    W: np.ndarray
    eps: float
    gamma: float
    acting: Acting | None = None
    of_model: np.ndarray | None = None

    def not_in_gaps(self, lcs: LCS) -> np.ndarray:
        """(n_lam, n_v) what of an error of the velocities is no error of gap speeds."""
        J = pushes(lcs)[0]
        return np.zeros_like(J) if self.of_model is None else J @ self.of_model


@dataclass(frozen=True, eq=False)
class Explained:
    """A step under some parameters: its loss, and the forces that explain it best."""

    lcs: LCS
    loss: float
    lam: np.ndarray  # (n_lam,) [N]
    acting: Acting
    f: np.ndarray  # (m,) [N]
    eta: np.ndarray  # (m,) [m/s]
    force: np.ndarray  # (m,) [N] eps times the loss's derivative in the gap speed
    D: np.ndarray  # (n_x, m) and
    F: np.ndarray  # (m, m), of f


def acting(
    lcs: LCS, sample: Sample, friction, noise: float, high=None, lam=None, open_=None
) -> Acting:
    """What the contacts' forces can be, by how they are seen to slide.

    A contact slides for certain where the slip's mean over the step is BEYOND_NOISE.
    Its force is then the normal's and friction times it against the slip, as Coulomb
    has it: the exact cone, of which the edges are an approximation. In another contact
    any force in the cone costs nothing, whatever the noise of a slip.

    Args: friction (n_lam,) of the rows' contacts; noise [m/s] of the slip's speed;
        infinite: none slides. high (n_lam,): anisotropy of ContactPair; None: ones.
        Where it is not 1 the cone's first axis stands for forces that no slip tells:
        any of them may act, and the contact slides if it does across that axis. They
        are those of a normal that is tilted, so the friction is that of both together:
        lam (n_lam,) says how large they are; None: none. open_ (n_lam,) bool: rows of
        contacts that no force can have; None: none.
    """
    J, _, contact = pushes(lcs)
    along = J - normals(lcs)
    n_v, n = sample.v_mean.size, len(J)
    v_ends = np.stack([sample.x_now[-n_v:], sample.x_next[-n_v:]])
    parts, slides = [np.zeros((4, n, 0))], np.zeros(n, bool)
    for one in np.unique(contact if open_ is None else contact[~open_]):
        mine = contact == one
        k, ratio = int(mine.sum()), 1.0 if high is None else high[mine][0]
        (_, axes), tilted = _edges(k), 1.0
        now, after = v_ends @ tangents(along, friction, mine, ratio).T
        slip, change = 0.5 * (now + after), after - now
        error, spread = noise**2, np.zeros(1)
        if ratio != 1.0:
            error, spread = error + slip[0] ** 2, np.array([-1.0, 1.0])
            slip[0] = change[0] = 0.0
            if lam is not None and lam[mine].sum() > 0.0:
                aside = tangent_edges(friction, mine, ratio)[:, 0] @ lam[mine]
                tilted = np.hypot(1.0, aside / lam[mine].sum())
        error += change @ change / 12.0  # A slip that turns evenly.
        slides[mine] = slip @ slip > BEYOND_NOISE**2 * error
        if slides[mine].any():
            size = np.linalg.norm(slip)
            angle = np.sqrt(error) / size  # By which the slip may be turned.
            against, across = np.array([-slip, [-slip[1], slip[0]]]) / size @ axes
            own = np.zeros((4, k, spread.size))
            own[0] = (1.0 / k + (1.0 - 0.5 * angle**2) * tilted * against)[:, None]
            own[0] += np.outer(axes[0], spread)
            own[2:] = np.stack([across, angle / np.sqrt(2.0) * against])[..., None]
            own[2:] *= angle
        elif ratio != 1.0:
            own = np.zeros((4, k, 4))
            corners = axes[0] * np.array([[1.0], [1.0], [-1.0], [-1.0]])
            corners = corners + tilted * axes[1] * np.array([[1.0], [-1.0]] * 2)
            own[0] = 1.0 / k + corners.T
        else:
            own = np.zeros((4, k, k))
            own[0] = np.eye(k)
        own /= np.sqrt(own.shape[2])  # All ways of a contact together count once.
        own[1] = own[0].sum(axis=0) / k
        parts.append(np.zeros((4, n, own.shape[2])))
        parts[-1][:, mine] = own
    ways, rows, *errors = np.concatenate(parts, axis=2)
    return Acting(ways, rows, slides, np.array(errors))


def lacks_of(lcs: LCS, sample: Sample) -> np.ndarray:
    """(n_x,) what the model about the middle lacks of the measured change without
    contact forces."""
    x = sample.x
    return lcs.A @ x + lcs.B @ sample.u + lcs.d - x - (sample.x_next - sample.x_now)


def step_of(lcs: LCS, sample: Sample):
    """lacks_of, and (n_lam,) the gap velocities at the end without contact forces."""
    lacks, n_v = lacks_of(lcs, sample), sample.v_mean.size
    # A contact that pushes is closed somewhere in the step: its row has the smallest
    # gap of it, instead of one that the end's velocity extrapolates, and the error of
    # that velocity: Anitescu's contact would open as it slides.
    return lacks, nearest(lcs, sample) + pushes(lcs)[0] @ lacks[-n_v:]


def scatter(share, change, M) -> np.ndarray:
    """(n_v, n_v) covariance of velocities: in any direction, in parts `share` of the
    size of `change` (n_x,), as the mass matrix M (n_v, n_v) measures it."""
    n_v = len(M)
    size = share**2 * (change[-n_v:] @ M @ change[-n_v:]) / n_v
    return size * np.linalg.inv(M)


def error_weights(Q_d, more) -> tuple[np.ndarray, np.ndarray]:
    """(n_x, n_x) inverse covariance of a step's errors, and (n_v, n_v) what part of an
    error of the velocities is the model's.

    Args: Q_d (n_x,) inverse variances that do not depend on the step; more (n_v, n_v):
        covariance of the velocities' other errors.
    """
    n_v = len(more)
    W = np.diag(np.asarray(Q_d, dtype=float))
    Q, of_sensors = W[-n_v:, -n_v:], np.eye(n_v)
    if more.any():  # (1 / Q + more)^-1, as Q may be zero.
        of_sensors = np.linalg.inv(of_sensors + more @ Q)
        W[-n_v:, -n_v:] = Q @ of_sensors
    return W, np.eye(n_v) - of_sensors


def root_of(W) -> np.ndarray:
    """(n, n) R with R' R = W, which is positive semi-definite."""
    values, vectors = np.linalg.eigh(W)
    return np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T


def impact_part(lcs: LCS, sample: Sample, lacks, apart) -> float:
    """Part, 0 to 1, of the energy of the change `lacks` (n_x,) that is of contacts
    whose bodies meet or part in the step: nothing while they move together, or where
    they are apart, (n_lam,) bool of the rows. (What explains the step without a force
    of the others may be wrong.)"""
    n_v = sample.v_mean.size
    dv, energy = (sample.x_next - sample.x_now)[-n_v:], 0.0
    contact, of_rows = pushes(lcs)[2], normals(lcs)
    for one in np.unique(contact[~apart]):
        normal = of_rows[contact == one][0]
        if normal.any():
            mobility = normal @ np.linalg.solve(sample.M, normal)
            if mobility > 0.0:
                energy = max(energy, (normal @ dv) ** 2 / mobility)
    whole = lacks[-n_v:] @ sample.M @ lacks[-n_v:]
    return float(min(energy / whole, 1.0)) if whole > 0.0 else 0.0


def pushes(lcs: LCS) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """J, phi and contact of an LCS that has them. Raises: ValueError."""
    if lcs.J is None or lcs.phi is None or lcs.contact is None:
        raise ValueError("the LCS does not say what its forces push along")
    return lcs.J, lcs.phi, lcs.contact


def normals(lcs: LCS) -> np.ndarray:
    """(n_lam, n_v) what the normal force of each row's contact pushes along; zero where
    w holds no gap."""
    J, phi, contact = pushes(lcs)
    with_gap = np.isfinite(phi)
    same = (contact[:, None] == contact) & with_gap & with_gap[:, None]
    # The edges come in opposite pairs.
    return same @ J / np.maximum(same.sum(axis=1), 1)[:, None]


@lru_cache
def _edges(k: int) -> tuple[np.ndarray, np.ndarray]:
    """(k, 2) friction edges of a contact, and their pseudo-inverse (2, k)."""
    edges = friction_edges(max(k // 2, 1))[:k]
    return edges, np.linalg.pinv(edges)


def tangent_edges(friction, mine, high=1.0) -> np.ndarray:
    """(k, 2) force along the two tangents of a contact, of each of its k rows.

    Args: friction (n_lam,) of the rows' contacts; mine (n_lam,) bool: the contact's,
        of which high is the anisotropy.
    """
    return friction[mine][:, None] * _edges(int(mine.sum()))[0] * [high, 1.0]


def tangents(along, friction, mine, high=1.0) -> np.ndarray:
    """(2, n_v) what moves a contact along its two tangents: as of tangent_edges.

    Args: along (n_lam, n_v): what rows push along, less their normals.
    """
    axes, mu = _edges(int(mine.sum()))[1], friction[mine][0]
    return (axes / [[high], [1.0]] / mu if mu > 0.0 else 0.0 * axes) @ along[mine]


def nearest(lcs: LCS, sample: Sample) -> np.ndarray:
    """(n_lam,) the smallest measured gap of a contact in the step, over its time [m/s];
    zero where w holds no gap. It is at one of the ends, or, of a contact that came
    nearer at first and parts at last, where the two velocities meet."""
    (_, phi, _), normal, n_v = pushes(lcs), normals(lcs), sample.v_mean.size
    gap, mean = np.where(np.isfinite(phi), phi, 0.0) / lcs.dt, normal @ sample.v_mean
    nearing = np.maximum(-normal @ sample.x_now[-n_v:], 0.0)
    parting = np.maximum(normal @ sample.x_next[-n_v:], 0.0)
    both = np.maximum(nearing + parting, 1e-300)
    meet = np.where(parting > 0.0, np.clip((parting - mean) / both, 0.0, 1.0), 0.0)
    return np.minimum(gap - 0.5 * mean - nearing * meet, gap - 0.5 * abs(mean))


def explain(lcs: LCS, sample: Sample, loss: Loss) -> Explained | None:
    """The forces of the violation-based loss; None where its QP was not solved."""
    z, q = step_of(lcs, sample)
    own = loss.acting or acting(lcs, sample, np.ones(lcs.n_lam), np.inf)
    # The error of the end's velocity is one of the gap as far as it is the sensors'.
    n_v, not_there = sample.v_mean.size, loss.not_in_gaps(lcs)
    q = q - not_there @ z[-n_v:]
    D, q = lcs.D @ own.ways, own.rows.T @ q
    weighted = loss.eps * D.T @ loss.W
    P, p = weighted @ D, weighted @ z
    # As soft as one edge, and so soft that the QP is convex.
    F = own.rows.T @ (lcs.F - not_there @ lcs.D[-n_v:]) @ own.ways
    F += loss.gamma * (np.eye(len(q)) - own.rows.T @ own.ways)
    if not all(np.isfinite(of_qp).all() for of_qp in (P, p, F, q)):
        return None
    if not len(q):  # No contact.
        total = float(0.5 * z @ loss.W @ z)
        return Explained(lcs, total, np.zeros(lcs.n_lam), own, q, q, q, D, F)
    F += np.eye(len(q)) * max(loss.gamma - 0.5 * gamma_bound(F + 0.5 * P), 0.0)
    solved, cost, f, eta, force = solve_step(P, p, F, q, loss.gamma)
    total = float(0.5 * z @ loss.W @ z + cost / loss.eps)
    if not (solved and np.isfinite(total)):
        return None
    return Explained(lcs, total, own.ways @ f, own, f, eta, force, D, F)


def changes_by(lcs: LCS, other: LCS, sample: Sample, lam):
    """(n_x,), (n_lam,) how x_next and the gap velocities differ in another LCS, at the
    forces lam."""
    (z, q), (z_other, q_other) = (step_of(of, sample) for of in (lcs, other))
    dD, dF = other.D - lcs.D, other.F - lcs.F
    return z_other - z + dD @ lam, q_other - q + dF @ lam


def felt(found: Explained, root) -> np.ndarray:
    """(m,) bool: of the contacts whose force is BEYOND_NOISE, as root (n_x, n_x) weighs
    it. Of another nobody can say that it is closed: a gap that is larger than what is
    left of the force needs explains the step as well."""
    contact = pushes(found.lcs)[2]
    each = contact == np.unique(contact)[:, None]
    size = np.linalg.norm((each * found.lam) @ (root @ found.lcs.D).T, axis=1)
    return ((size > BEYOND_NOISE) @ each @ (found.acting.ways != 0.0)).astype(bool)


def _unexplained(columns, free):
    """What of the columns (n, k) no combination of those of free (n, m) is."""
    return columns - free @ np.linalg.lstsq(free, columns, rcond=1e-9)[0]


def gradient_and_information(
    found: Explained, sample: Sample, loss: Loss, dx, dw, one_sided=False
):
    """The loss's gradient (n,) and Gauss-Newton Hessian (n, n).

    Args: dx (n_x, n), dw (n_lam, n): derivatives of x_next and of the gap velocities
        at the forces found. one_sided (n,) bool: parameters which the step can tell to
        be larger, and never smaller: the friction of a contact that sticks. Noise that
        goes one way would count, and what goes the other way not, so such a step counts
        for nothing unless it is BEYOND_NOISE.
    """
    error = lacks_of(found.lcs, sample) + found.lcs.D @ found.lam
    dw = dw - loss.not_in_gaps(found.lcs) @ dx[-sample.v_mean.size :]
    dw = found.acting.rows.T @ dw
    gradient = dx.T @ loss.W @ error + dw.T @ found.force / loss.eps
    root, stiff = root_of(loss.W), 1.0 / np.sqrt(loss.eps * loss.gamma)
    closed, free = (found.eta == 0.0) & felt(found, root), found.f > 0.0
    of_z = np.vstack([root @ dx, stiff * dw[closed]])
    of_lam = np.vstack([root @ found.D[:, free], stiff * found.F[np.ix_(closed, free)]])
    of_z = _unexplained(of_z, of_lam)
    missed = np.append(root @ error, stiff * loss.gamma * found.force[closed])
    # Nor is it believed where the explanation parts what touches, as measured.
    apart = (
        BEYOND_NOISE * np.sqrt(loss.eps * loss.gamma) * found.acting.rows.sum(axis=0)
    )
    noise = one_sided & (
        ((of_z.T @ missed) ** 2 <= BEYOND_NOISE**2 * (of_z**2).sum(axis=0))
        | (found.eta > apart)[found.f > 0.0].any()
    )
    # Then its friction may be any, and what another parameter changes as a friction
    # does tells as little: a mass would get what the friction is not allowed to.
    # (Rounding errors of a friction that changes nothing have any direction.)
    changes = abs(of_z).max(axis=0, initial=0.0) > ROUNDING
    told = _unexplained(of_z, of_z[:, noise & changes])
    gradient, of_z = gradient + (told - of_z).T @ missed, told
    # A force at a distance stands for what the model lacks, and tells of gaps alone.
    far = nearest(found.lcs, sample) > BEYOND_NOISE * np.sqrt(loss.eps * loss.gamma)
    noise = noise | (dx.any(axis=0) & far[found.lam > 0.0].any())
    gradient, of_z = np.where(noise, 0.0, gradient), np.where(noise, 0.0, of_z)
    return gradient, of_z.T @ of_z


def updated(
    belief: Belief,
    sample: Sample,
    loss: Loss,
    trust: float,
    build: Callable[[np.ndarray], LCS],
    changes: Callable[[np.ndarray, LCS, np.ndarray], tuple[np.ndarray, ...]],
    starts=(),
) -> tuple[Belief, Explained | None]:
    """The belief after a step, and the step as the new mean explains it.

    Args:
        trust: factor on the loss.
        build: the LCS about the sample's x and u for z (n,).
        changes: for z, its LCS and the forces: the further arguments of
            gradient_and_information.
        starts: further z from which the minimum is looked for, as the loss is flat
            where a contact is missed; the best one is taken.
    Returns: the belief as it was, and None, where no QP was solved.
    """

    def tried(z, below=np.inf):
        """z, what it explains and the cost; None where that is not below `below`."""
        off = z - belief.mean
        cost = 0.5 * off @ belief.information @ off
        if not cost < below:  # Whatever the loss, which is not negative.
            return None
        try:
            found = explain(build(z), sample, loss)
        except (ValueError, RuntimeError):
            return None
        if found is None or not cost + trust * found.loss < below:
            return None
        return z, found, cost + trust * found.loss

    best = tried(belief.mean)
    for start in starts:
        best = tried(start, np.inf if best is None else best[2]) or best
    if best is None:
        return belief, None
    z, found, cost = best
    more = np.zeros_like(belief.information)
    for _ in range(NEWTON_STEPS):
        of_z = changes(z, found.lcs, found.lam)
        gradient, information = gradient_and_information(found, sample, loss, *of_z)
        more = trust * information
        slope = belief.information @ (z - belief.mean) + trust * gradient
        step = -np.linalg.solve(belief.information + more, slope)
        for _ in range(HALVINGS):
            trial = tried(z + step, cost)
            if trial is not None:
                break
            step = 0.5 * step
        if trial is None:
            break
        z, found, cost = trial
        if np.abs(step).max() < SMALL:
            break
    return Belief(z, belief.information + more), found


def less_certain(belief: Belief, variance) -> Belief:
    """The belief with further variance (n,); never less certain than the model."""
    if not np.any(variance):
        return belief
    covariance = np.linalg.inv(belief.information)
    room = np.clip(1.0 - np.diag(covariance), 0.0, None)
    covariance = covariance + np.diag(np.minimum(variance, room))
    return Belief(belief.mean.copy(), np.linalg.inv(covariance))


def certain_part(belief: Belief) -> np.ndarray:
    """z (n,) to act on: the mean, less where it is not known.

    What is within one deviation of the model's value, were all others known, stays
    there. Given this, along each principal direction of the others' belief the mean a
    with deviation s is taken (1 - s^2 / a^2) times, within one deviation not at all. So
    a ratio of two parameters that is known is acted on though neither of them is; and
    what is known equally well, but has nothing to do with each other, stays apart:
    principal directions alone would mix it.
    """
    z, known = np.zeros(len(belief.mean)), belief.information
    changed = np.diag(known) * belief.mean**2 > 1.0
    information, directions = np.linalg.eigh(known[np.ix_(changed, changed)])
    along = directions.T @ np.linalg.solve(
        known[np.ix_(changed, changed)], (known @ belief.mean)[changed]
    )
    share = 1.0 - 1.0 / np.maximum(information * along**2, 1.0)
    z[changed] = directions @ (share * along)
    return z
