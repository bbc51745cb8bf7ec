"""Points of circles, spheres and ellipses, samples made of them, and a fitter of every method by name."""

import numpy as np
from synthetic_flight import turn

from magmav.core.estimators.fit import Fitter, fit_points
from magmav.core.estimators.minmax import MinMaxFitter
from magmav.core.estimators.moments import Moments
from magmav.core.estimators.streaming import METHODS, MomentsFitter
from magmav.core.estimators.sytnyk import SytnykFitter
from magmav.core.types import NO_SHAPING, Sample, Shaping, vec3

ROUND = ("kasa", "bullock", "taubin")
CONIC = ("ellipse", "ellipsoid")
ALL_2D = (*ROUND, "minmax", "ellipse", "sytnyk")
ALL_3D = (*ROUND, "minmax", "ellipsoid")


def fitter(method: str, d: int, scale: float = 200.0, forget: float = 1.0, watch: bool = False) -> Fitter:
    """A fresh one that takes what is least for its figure and one point more."""
    moments = Moments(d, scale, forget)
    if method == "minmax":
        return MinMaxFitter(moments, 4)
    if method == "sytnyk":
        return SytnykFitter(moments, 6)
    return MomentsFitter(moments, METHODS[method], d + 2, watch)


def fitted(method, points, scale=200.0, forget=1.0):
    """Fit or Refusal of points (n, d)."""
    points = np.asarray(points, dtype=float)
    return fit_points(points, fitter(method, points.shape[1], scale, forget))


def ring(n, radius=200.0, centre=(0.0, 0.0), degrees=360.0, start=0.0, noise=0.0, seed=0):
    """An arc at random angles, (n, 2); noise is one sigma per axis in the unit of the radius."""
    r = np.random.default_rng(seed)
    a = np.radians(start + r.uniform(0.0, degrees, n))
    return radius * np.stack((np.cos(a), np.sin(a)), 1) + centre + r.normal(0.0, noise, (n, 2))


def ball(n, radius=476.0, centre=(0.0, 0.0, 0.0), noise=0.0, seed=0):
    """Every direction there is, (n, 3)."""
    r = np.random.default_rng(seed)
    d = r.normal(size=(n, 3))
    return radius * d / np.linalg.norm(d, axis=1)[:, None] + centre + r.normal(0.0, noise, (n, 3))


def figure(d, n=60, noise=0.0, seed=0, centre=None):
    """A ring or a ball."""
    centre = np.zeros(d) if centre is None else centre
    return ring(n, 200.0, centre, noise=noise, seed=seed) if d == 2 else ball(n, 200.0, centre, noise, seed)


def rotation(d, a, b=0.0, c=0.0):
    """A proper rotation, (d, d)."""
    if d == 2:
        return np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    return turn(0, a) @ turn(1, b) @ turn(2, c)


def sample(mag, shaping: Shaping = NO_SHAPING, roll=0.0, pitch=0.0, learn=True, axes=3) -> Sample:
    """A Sample of nothing but a field and a tilt."""
    zero = vec3((0, 0, 0), "rate")
    return Sample(
        system=1,
        compass=1,
        boot_ns=0,
        dt_s=0.1,
        mag_b_mg=vec3(mag, "field"),
        shaping=shaping,
        rate_b_rads=zero,
        roll_rad=roll,
        pitch_rad=pitch,
        yaw_step_rad=0.0,
        lead_rad=0.0,
        age_s=0.0,
        gap=False,
        tilt_from="ATTITUDE",
        learn=learn,
        axes=axes,
    )


def taught(estimator, fields, rolls=0.0, pitches=0.0, shaping: Shaping = NO_SHAPING, axes=3):
    """The estimator after fields (n, 3) at these tilts."""
    n = len(fields)
    for m, roll, pitch in zip(fields, np.broadcast_to(rolls, n), np.broadcast_to(pitches, n), strict=True):
        estimator.step(sample(m, shaping, float(roll), float(pitch), axes=axes))
    return estimator


def seen_from(rolls, pitches, yaws, earth_mg):
    """The Earth's field (3,) in body axes at these attitudes, (n, 3)."""
    angles = zip(rolls, pitches, yaws, strict=True)
    return np.array([turn(0, r) @ turn(1, p) @ turn(2, y) @ np.asarray(earth_mg) for r, p, y in angles])
