"""Lines, arcs and splines of a pose, by arc length: position and orientation with three
derivatives.

A pose is six numbers X = [p, r]: position [m] and the rotation vector r [rad], world
axes, that takes the pattern's first orientation to this one. A path gives X(s), s the
arc length of p. Beyond its ends a line goes on as a line, an arc along its circle, and
a spline straight: its curvature and the next two derivatives are 0 at both ends.

A pattern is one flat array, so that compiled code can take any: the number of
segments, per segment a head of HEAD numbers, then each segment's data.

    line    X(0) 6, dX/ds 6
    arc     centre 3, e1 3, e2 3, radius, r(0) 3, dr/ds 3;  p = c + R (e1 cos + e2 sin)
    spline  spans m, u at their ends (m + 1), s there (m + 1), coefficients (m, 8, 6)
            of powers of u - u_i, X and dX/ds at the start 12, at the end 12
"""

from math import factorial

import numba
import numpy as np
from scipy.interpolate import make_interp_spline

LINE, ARC, SPLINE = range(3)
HEAD = 24
# In the head.
KIND, LENGTH, SPEED, N_FORCE = 0, 1, 2, 3
DIRECTIONS, TARGETS = 4, 10  # Of the forces: two rows of three, two numbers.
IN_CONTACT, IN_LOSS, GOES_ON, START, END, DATA = 12, 13, 14, 15, 16, 17
BENDS_AT = 513  # Points of a path among which it bends most.
_DEGREE = 7
_NODES, _WEIGHTS = (0.5 * x for x in np.polynomial.legendre.leggauss(12))
_NODES = _NODES + 0.5


@numba.njit(cache=True)
def add_along(C, n, distance):
    """C += n distance in place, in the first three entries."""
    for i in range(3):
        C[i] += n[i] * distance


@numba.njit(cache=True)
def head(table, k, i):
    """Entry i of the head of segment k in a pattern's table."""
    return table[1 + k * HEAD + i]


@numba.njit(cache=True)
def force_direction(table, k, row):
    """(3,) the force direction `row` (0 or 1) of segment k, a view."""
    start = 1 + k * HEAD + DIRECTIONS + 3 * row
    return table[start : start + 3]


@numba.njit(cache=True)
def _polynomial(table, at, x, order):
    """The polynomial's derivative of that order (6,) at x."""
    out = np.zeros(6)
    for power in range(_DEGREE, order - 1, -1):
        factor = 1.0
        for j in range(order):
            factor *= power - j
        for i in range(6):
            out[i] = out[i] * x + factor * table[at + 6 * power + i]
    return out


@numba.njit(cache=True)
def _speed_of_u(table, at, x):
    d = _polynomial(table, at, x, 1)
    return np.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])


@numba.njit(cache=True)
def _length_of_u(table, at, x):
    """Arc length from the start of a span to x in it."""
    total = 0.0
    for i in range(_NODES.shape[0]):
        total += _WEIGHTS[i] * _speed_of_u(table, at, x * _NODES[i])
    return total * x


@numba.njit(cache=True)
def path_point(table, segment, s):
    """X (6,) and three derivatives by arc length, (4, 6), of `segment` at s [m]."""
    out = np.zeros((4, 6))
    head = 1 + segment * HEAD
    at, length = int(table[head + DATA]), table[head + LENGTH]
    kind = int(table[head + KIND])
    if kind == LINE:
        for i in range(6):
            out[1, i] = table[at + 6 + i]
            out[0, i] = table[at + i] + s * out[1, i]
        return out
    if kind == ARC:
        R = table[at + 9]
        cosine, sine = np.cos(s / R), np.sin(s / R)
        for i in range(3):
            e1, e2 = table[at + 3 + i], table[at + 6 + i]
            radial, tangent = cosine * e1 + sine * e2, cosine * e2 - sine * e1
            out[0, i] = table[at + i] + R * radial
            out[1, i], out[2, i] = tangent, -radial / R
            out[3, i] = -tangent / (R * R)
            out[1, 3 + i] = table[at + 13 + i]
            out[0, 3 + i] = table[at + 10 + i] + s * table[at + 13 + i]
        return out

    m = int(table[at])
    u0, s0 = at + 1, at + 2 + m
    coefficients = s0 + m + 1
    ends = coefficients + 48 * m
    if s <= 0.0 or s >= length:
        end = ends if s <= 0.0 else ends + 12
        beyond = s if s <= 0.0 else s - length
        for i in range(6):
            out[1, i] = table[end + 6 + i]
            out[0, i] = table[end + i] + beyond * out[1, i]
        return out
    span = np.searchsorted(table[s0 : s0 + m + 1], s, side="right") - 1
    span = min(max(span, 0), m - 1)
    c = coefficients + 48 * span
    width = table[u0 + span + 1] - table[u0 + span]
    rest = s - table[s0 + span]
    x = width * rest / (table[s0 + span + 1] - table[s0 + span])
    for _ in range(8):  # Newton; the integrand is positive and nearly constant.
        step = (_length_of_u(table, c, x) - rest) / _speed_of_u(table, c, x)
        x -= step
        if abs(step) < 1e-14 * width:
            break
    d1, d2, d3 = (
        _polynomial(table, c, x, 1),
        _polynomial(table, c, x, 2),
        _polynomial(table, c, x, 3),
    )
    out[0] = _polynomial(table, c, x, 0)
    g2, h, h1 = 0.0, 0.0, 0.0
    for i in range(3):
        g2 += d1[i] * d1[i]
        h += d1[i] * d2[i]
        h1 += d2[i] * d2[i] + d1[i] * d3[i]
    # u by s: u' = 1 / |P_u|, and so on.
    v1 = 1.0 / np.sqrt(g2)
    v2 = -h / g2**2
    v3 = v1 * (4.0 * h * h / g2**3 - h1 / g2**2)
    for i in range(6):
        out[1, i] = d1[i] * v1
        out[2, i] = d2[i] * v1**2 + d1[i] * v2
        out[3, i] = d3[i] * v1**3 + 3.0 * d2[i] * v1 * v2 + d1[i] * v3
    return out


@numba.njit(cache=True)
def last_parameter(table, segment):
    """The parameter of `place` at the end of an arc or a spline."""
    if int(table[1 + segment * HEAD + KIND]) == ARC:
        return head(table, segment, LENGTH)
    return table[int(head(table, segment, DATA))]


@numba.njit(cache=True)
def place(table, segment, w):
    """Position [m], the first three of (6,), on an arc or a spline at a parameter that
    needs no arc length to be inverted, 200 times as quick there as path_point.

    Args: w: on an arc, arc length [m]; on a spline of m spans, the spans from its start
        (2.5: in the middle of the third), and beyond its end m + the way from there
        [m]; at least 0.
    """
    m = last_parameter(table, segment)
    if int(head(table, segment, KIND)) == ARC:
        return path_point(table, segment, w)[0]
    if w >= m:
        return path_point(table, segment, head(table, segment, LENGTH) + w - m)[0]
    at, x = _in_span(table, segment, w)
    return _polynomial(table, at, x, 0)


@numba.njit(cache=True)
def length_to(table, segment, w):
    """Arc length [m] from the start to the parameter w of `place`."""
    m = last_parameter(table, segment)
    if int(head(table, segment, KIND)) == ARC:
        return w
    if w >= m:
        return head(table, segment, LENGTH) + w - m
    at, x = _in_span(table, segment, w)
    s0 = int(head(table, segment, DATA)) + 2 + int(m)
    return table[s0 + int(w)] + _length_of_u(table, at, x)


@numba.njit(cache=True)
def _in_span(table, segment, w):
    """Where the polynomial of a spline's span is in the table, and u from its start."""
    at, span = int(head(table, segment, DATA)), int(w)
    u0 = at + 1 + span
    coefficients = at + 3 + 2 * int(table[at])
    return coefficients + 48 * span, (w - span) * (table[u0 + 1] - table[u0])


@numba.njit(cache=True)
def largest_curvature(table, segment):
    """Of the position along `segment` [1/m], among BENDS_AT of its points."""
    length, most = table[1 + segment * HEAD + LENGTH], 0.0
    for i in range(BENDS_AT):
        bend = path_point(table, segment, length * i / (BENDS_AT - 1))[2]
        most = max(most, bend[0] ** 2 + bend[1] ** 2 + bend[2] ** 2)
    return np.sqrt(most)


def line_data(X0, X1):
    """Length [m] and data of the line from X0 to X1 (6,)."""
    length = float(np.linalg.norm((X1 - X0)[:3]))
    return length, np.concatenate([X0, (X1 - X0) / length])


def arc_data(p0, via, p1, r0, r1):
    """Length [m] and data of the circular arc from p0 over via to p1 (3,).

    Raises: ValueError if the three lie on a line.
    """
    a, b = via - p0, p1 - p0
    normal = np.cross(a, b)
    area = np.linalg.norm(normal)
    if not area > 1e-9 * np.linalg.norm(a) * np.linalg.norm(b):
        raise ValueError(
            f"arc through {p0}, {via}, {p1}: expected three points that are not on a "
            "line"
        )
    to_centre = np.cross(a @ a * b - b @ b * a, normal) / (2.0 * area**2)
    centre, R = p0 + to_centre, float(np.linalg.norm(to_centre))
    e1, axis = -to_centre / R, normal / area
    e2 = np.cross(axis, e1)  # The sense of p0, via, p1.
    end = p1 - centre
    angle = np.arctan2(end @ e2, end @ e1) % (2.0 * np.pi)
    length = R * angle
    return length, np.concatenate([centre, e1, e2, [R], r0, (r1 - r0) / length])


def spline_data(X):
    """Length [m] and data of the smooth path through X (n, 6), n >= 3: of degree 7 with
    six continuous derivatives in its chord length, and straight at its ends."""
    chord = np.linalg.norm(np.diff(X[:, :3], axis=0), axis=1)
    u = np.concatenate([[0.0], np.cumsum(chord)])
    straight = [(order, np.zeros(6)) for order in (2, 3, 4)]
    spline = make_interp_spline(u, X, k=_DEGREE, bc_type=(straight, straight))
    breaks = np.unique(spline.t)
    powers = np.stack(  # (m, 8, 6): Taylor's, lowest power first.
        [spline(breaks[:-1], nu=j) / factorial(j) for j in range(_DEGREE + 1)], axis=1
    )
    # Cut until the quadrature of the arc length is exact to rounding.
    breaks, powers = _refine(breaks, powers, 4)
    coefficients = np.ascontiguousarray(powers).ravel()
    m = len(breaks) - 1
    s = np.zeros(m + 1)
    for i in range(m):
        width = breaks[i + 1] - breaks[i]
        s[i + 1] = s[i] + _length_of_u(coefficients, 48 * i, width)
    ends = []
    for i, x in ((0, 0.0), (m - 1, breaks[m] - breaks[m - 1])):
        slope = _polynomial(coefficients, 48 * i, x, 1)
        ends += [_polynomial(coefficients, 48 * i, x, 0)]
        ends += [slope / np.linalg.norm(slope[:3])]
    data = np.concatenate([[m], breaks, s, coefficients, *ends])
    return float(s[-1]), data


def _refine(breaks, powers, times):
    """Each span cut into `times` equal ones, the polynomials the same."""
    new_breaks, new_powers = [], []
    for i, c in enumerate(powers):
        width = (breaks[i + 1] - breaks[i]) / times
        for j in range(times):
            shift = j * width
            out = np.zeros_like(c)
            for power in range(_DEGREE + 1):  # Taylor: c(x + shift).
                binomial = 1.0
                for low in range(power, -1, -1):
                    out[low] += binomial * shift ** (power - low) * c[power]
                    binomial *= low / (power - low + 1.0)
            new_breaks.append(breaks[i] + shift)
            new_powers.append(out)
    return np.array([*new_breaks, breaks[-1]]), np.array(new_powers)


@numba.njit(cache=True)
def rotation_motion(r, r1, r2, base):
    """Orientation exp(r) base, its angular velocity and acceleration.

    Args: r (3,) rotation vector [rad], r1, r2 its time derivatives; base (4,) wxyz.
    Returns: quaternion wxyz (4,), w (3,) [rad/s], alpha (3,) [rad/s2], world axes.
    """
    # exp(r) = [g(x), f(x) r] with x = r.r, f = sin(a/2)/a, g = cos(a/2), a = sqrt(x).
    x = r @ r
    dx = 2.0 * (r @ r1)
    ddx = 2.0 * (r1 @ r1 + r @ r2)
    if x < 1e-2:
        # Series: the terms left out are below 1e-16.
        f = 0.5 - x / 48.0 + x**2 / 3840.0 - x**3 / 645120.0 + x**4 / 185794560.0
        f1 = -1.0 / 48.0 + x / 1920.0 - x**2 / 215040.0 + x**3 / 46448640.0
        f2 = 1.0 / 1920.0 - x / 107520.0 + x**2 / 15482880.0
        g = np.cos(0.5 * np.sqrt(x))
    else:
        a = np.sqrt(x)
        f, g = np.sin(0.5 * a) / a, np.cos(0.5 * a)
        f1 = (0.25 * g - 0.5 * f) / x
        f2 = -(f / 16.0 + 1.5 * f1) / x
    g1, g2 = -0.25 * f, -0.25 * f1
    v = f * r
    dv = f * r1 + f1 * dx * r
    ddv = f * r2 + 2.0 * f1 * dx * r1 + (f2 * dx * dx + f1 * ddx) * r
    dg = g1 * dx
    ddg = g2 * dx * dx + g1 * ddx
    w = 2.0 * (g * dv - dg * v - _cross(dv, v))  # 2 dq conj(q), its vector part.
    alpha = 2.0 * (g * ddv - ddg * v - _cross(ddv, v))
    q = np.empty(4)
    b = base[1:4]
    q[0] = g * base[0] - v @ b
    q[1:] = g * b + base[0] * v + _cross(v, b)
    return q, w, alpha


@numba.njit(cache=True)
def _cross(a, b):
    out = np.empty(3)
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]
    return out
