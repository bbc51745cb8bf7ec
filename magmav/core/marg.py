"""Attitude from down and magnetic north by the magnetic reference vector: two references, two solvers, the closed form.

Source: the MARG reference-vector paper (Czech; equations M1 to M6 in seed-methods.md section 3). Quaternions are
(w, x, y, z), body to earth: R(q) v = q v q*. Earth axes are north, east, down; north is magnetic unless north_rad turns
it. The two measured directions are the pair (a, m), unit and in body axes: a points down, m along the Earth's field.

Both references and both solvers end at the same attitude (fact 2), the closed form, whose yaw is the tilt-compensated
heading. The six-row error is zero there whatever the field is, so it cannot show a disturbance.

DEVIATES: with MAVLink's specific force f the paper's a is -f/|f|; f itself gives roll - 180, -pitch, -yaw (M6).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magmav.core.rotation import cross_matrix
from magmav.core.types import Mat3, Vec3

Array = NDArray[np.float64]
Quaternion = NDArray[np.float64]

LEAST_SINE = 0.03
"""Down and field closer than 1.7 degrees: at a magnetic pole north means nothing, and the Jacobian loses a rank."""
_DOWN_N = np.array((0.0, 0.0, 1.0))
_EYE3 = np.eye(3)


class Pair(NamedTuple):
    """Down and the field, (3,) unit vectors in body axes, and the cosine and sine of the angle between them."""

    down_b: Vec3
    field_b: Vec3
    cosine: float
    sine: float


def pair(force_b: Array, field_b: Array) -> Pair | None:
    """The pair from specific force and field, (3,) in any units. None where they fix no attitude.

    That is: either is zero or not finite, or both lie within 1.7 degrees of one line (a magnetic pole, a bad sensor).
    DEVIATES: M5 prints sqrt(1 - cos^2), which has no digits left near the pole and may be NaN; here it is |a x m|.
    DEVIATES: M4 as scanned divides by |a| + |m|; right is the product, here 1.
    """
    force, field = float(np.linalg.norm(force_b)), float(np.linalg.norm(field_b))
    if not (0.0 < force < math.inf and 0.0 < field < math.inf):
        return None
    a, m = -force_b / force, field_b / field
    sine = float(np.linalg.norm(cross(a, m)))
    return Pair(a, m, float(a @ m), sine) if sine >= LEAST_SINE else None


# ---------------------------------------------------------------- quaternions


def multiply(p: Quaternion, q: Quaternion) -> Quaternion:
    """Hamilton's product, (4,): R(p q) = R(p) R(q)."""
    a, b, c, d = p.tolist()
    w, x, y, z = q.tolist()
    return np.array(
        (
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        )
    )


def conjugate(q: Quaternion) -> Quaternion:
    """The turn back, (4,)."""
    return q * (1.0, -1.0, -1.0, -1.0)


def unit(q: Array) -> Array:
    """The same direction with length 1, any shape (N,)."""
    return q / math.sqrt(float(q @ q))


def aligned(q: Quaternion, like: Quaternion) -> Quaternion:
    """q or -q, the same rotation: the one on the side of ``like``."""
    return -q if float(q @ like) < 0.0 else q


def turned(turn_rad: Array) -> Quaternion:
    """The rotation by the vector ``turn_rad`` (3,), exact at any size."""
    x, y, z = turn_rad.tolist()
    angle = math.sqrt(x * x + y * y + z * z)
    share = 0.5 - angle * angle / 48.0 if angle < 1e-4 else math.sin(0.5 * angle) / angle
    return np.array((math.cos(0.5 * angle), share * x, share * y, share * z))


def turn_between(start: Quaternion, end: Quaternion) -> Vec3:
    """Rotation vector (3,) rad, earth axes, that takes ``start`` to ``end`` the short way round."""
    w, x, y, z = multiply(end, conjugate(start)).tolist()
    sine = math.sqrt(x * x + y * y + z * z)
    if sine < 1e-12:
        return 2.0 * math.copysign(1.0, w) * np.array((x, y, z))
    return 2.0 * math.atan2(math.copysign(sine, w), abs(w)) / sine * np.array((x, y, z))


def matrix(q: Quaternion) -> Mat3:
    """R(q) (3, 3), body to earth, of a unit quaternion."""
    w, x, y, z = q.tolist()
    return np.array(
        (
            (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
            (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
            (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
        )
    )


def from_matrix(R: Mat3) -> Quaternion:
    """The quaternion of a rotation matrix, w >= 0. The largest of the four parts is taken from the diagonal."""
    xx, yy, zz = float(R[0, 0]), float(R[1, 1]), float(R[2, 2])
    four = np.array((1.0 + xx + yy + zz, 1.0 + xx - yy - zz, 1.0 - xx + yy - zz, 1.0 - xx - yy + zz))
    rows = (
        (four[0], R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]),
        (R[2, 1] - R[1, 2], four[1], R[1, 0] + R[0, 1], R[0, 2] + R[2, 0]),
        (R[0, 2] - R[2, 0], R[1, 0] + R[0, 1], four[2], R[2, 1] + R[1, 2]),
        (R[1, 0] - R[0, 1], R[0, 2] + R[2, 0], R[2, 1] + R[1, 2], four[3]),
    )
    q = unit(np.array(rows[int(np.argmax(four))]))
    return aligned(q, np.array((1.0, 0.0, 0.0, 0.0)))


def cross(u: Array, v: Array) -> Vec3:
    """u x v, (3,). numpy's own takes ten times as long on three numbers."""
    a, b, c = u.tolist()
    x, y, z = v.tolist()
    return np.array((b * z - c * y, c * x - a * z, a * y - b * x))


# ---------------------------------------------------------------- references


def dynamic_reference(q: Quaternion, p: Pair, north_rad: float = 0.0) -> Vec3:
    """Madgwick's reference, unit (3,), earth axes: the field as q sees it, swung into the north plane (M3).

    It depends on the tilt of q alone, and a tilt error of t puts up to t into its inclination (fact 1).
    DEVIATES: M3 is scanned with h3 under the root; right is hy^2.
    """
    hx, hy, hz = (matrix(q) @ p.field_b).tolist()
    level = math.hypot(hx, hy)
    return np.array((level * math.cos(north_rad), level * math.sin(north_rad), hz))


def direct_reference(p: Pair, north_rad: float = 0.0) -> Vec3:
    """The reference from the measured angle between down and field alone, unit (3,), earth axes (M4 to M6).

    north_rad : azimuth of magnetic north from the reference's x axis (the paper's beta). The declination gives true
    yaw; minus the yaw at the start makes that yaw zero.
    DEVIATES: M4 calls the cosine that of the inclination I; it is that of 90 degrees - I.
    """
    return np.array((p.sine * math.cos(north_rad), p.sine * math.sin(north_rad), p.cosine))


# ---------------------------------------------------------------- error and solvers


def error(q: Quaternion, p: Pair, reference_n: Vec3) -> Array:
    """E = [a_r - R a; m_r - R m], (6,), with a_r = (0, 0, 1) (M1).

    DEVIATES: M1 prints a stray x on its right side; it belongs to M2.
    """
    R = matrix(q)
    return np.concatenate((_DOWN_N - R @ p.down_b, reference_n - R @ p.field_b))


def row_jacobian(q: Quaternion, v: Vec3) -> Array:
    """d(R(q) v)/dq, (3, 4), of q v q* as it stands, so that the length of q counts too and the rank stays full.

    d/dw = 2 (w v + r x v), d/dr = 2 [(r.v) I + r v' - v r' - w [v]x] with q = (w, r).
    """
    w, r = float(q[0]), q[1:]
    x, y, z = v.tolist()
    out = np.empty((3, 4))
    out[:, 0] = 2.0 * (w * v + cross(r, v))
    skew = cross_matrix(x, y, z)
    out[:, 1:] = 2.0 * (float(r @ v) * _EYE3 + r[:, None] * v - v[:, None] * r - w * skew)
    return out


def jacobian(q: Quaternion, p: Pair) -> Array:
    """d(R a, R m)/dq, (6, 4). Singular values of a unit q: 2 sqrt 2 twice, 2 sqrt(1 + sin I), 2 sqrt(1 - sin I)."""
    return np.concatenate((row_jacobian(q, p.down_b), row_jacobian(q, p.field_b)))


def descend(q: Quaternion, J: Array, E: Array, mu: float) -> Quaternion:
    """One step of gradient descent: unit(q + mu J' E), for the rows given.

    On the six rows it settles for mu < 1/4 (direct), 1 / (2 (1 + sin I)) (dynamic); the slow mode shrinks by
    |1 - 4 mu (1 - sin I)| a step under either reference (fact 3).
    """
    return unit(q + mu * (J.T @ E))


def descend_normalised(q: Quaternion, J: Array, E: Array, mu: float) -> Quaternion:
    """Madgwick's form, unit(q + mu g / |g|): never settles, but hops between two points mu apart (fact 5)."""
    gradient = J.T @ E
    size = math.sqrt(float(gradient @ gradient))
    return q if size == 0.0 else unit(q + mu / size * gradient)


def gauss_newton(q: Quaternion, J: Array, E: Array) -> Quaternion:
    """One Gauss-Newton step: unit(q + pinv(J) E), for the rows given. Fewer than four ranks: the shortest step."""
    return unit(q + np.linalg.pinv(J, rcond=1e-9) @ E)


Step = Callable[[Quaternion, Array, Array], Quaternion]
"""(q, J (n, 4), E (n,)) -> the next q."""


class Solution(NamedTuple):
    """Where an iteration came to rest, and after how many steps."""

    q: Quaternion
    steps: int
    settled: bool


def solve(
    q: Quaternion,
    p: Pair,
    step: Step,
    *,
    dynamic: bool = False,
    north_rad: float = 0.0,
    tolerance: float = 1e-15,
    limit: int = 2000,
) -> Solution:
    """Step from q until a step moves it no further than ``tolerance`` (length in quaternion space)."""
    fixed = direct_reference(p, north_rad)
    for n in range(1, limit + 1):
        reference = dynamic_reference(q, p, north_rad) if dynamic else fixed
        before, q = q, step(q, jacobian(q, p), error(q, p, reference))
        if float(np.linalg.norm(q - before)) <= tolerance:
            return Solution(q, n, True)
    return Solution(q, limit, False)


def closed_form(p: Pair, north_rad: float = 0.0) -> Quaternion:
    """What every settled iteration ends at: rows of R are north e x a, east e = unit(a x m), down a (fact 2)."""
    east = unit(cross(p.down_b, p.field_b))
    q = from_matrix(np.array((cross(east, p.down_b), east, p.down_b)))
    return q if north_rad == 0.0 else multiply(turned(north_rad * _DOWN_N), q)
