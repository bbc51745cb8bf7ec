"""Every number that was chosen, with its unit and where it comes from (estimation.md section 5 unless said)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Model:
    """One account of the compass: how likely before any data, and what it lets change."""

    weight: float
    iron_walk_mg: float  # per square root of a second
    soft_diagonal: float
    soft_cross: float

    def soft_variances(self) -> NDArray[np.float64]:
        """Of the six numbers of S."""
        return np.repeat((self.soft_diagonal**2, self.soft_cross**2), 3)


HARD = Model(0.70, 0.05, 0.003, 0.002)
SOFT_IRON = Model(0.27, 0.05, 0.04, 0.028)
DRIFT = Model(0.03, 0.7, 0.003, 0.002)
MODELS = (HARD, SOFT_IRON, DRIFT)
FIRST = 0  # of MODELS: while the heading is unknown it stands for all


@dataclass(frozen=True, slots=True)
class Tuning:
    """Noise, priors and lines."""

    yaws: int = 12
    yaws_again: int = 8  # headings to begin from when all else is known
    prior_iron_mg: float = 300.0
    ground_mg: float = 100.0  # what was learnt by hand may be off by so much in flight
    mounting_rad: float = math.radians(0.2)  # how crooked the compass may sit
    model_mg: float = 3.0  # of the world model, per component
    blind_h_mg: tuple[float, float] = (
        230.0,
        80.0,
    )  # without a position: mean and sigma
    blind_v_mg: float = 200.0
    field_known: float = 0.25  # of that sigma of H is left when the field counts as learnt
    soft_most: float = 0.15  # more is no soft iron but a filter gone astray
    block_s: float = 0.4  # readings taken in together span at most this
    block_readings: int = 8  # and are at most so many
    nodes_most: int = 3000  # of a whole flight known afterwards, about; in more than 20 minutes they are longer
    white_mg: float = 5.0  # one reading's own noise at first, and its limits
    white_lo_mg: float = 2.0
    white_hi_mg: float = 15.0
    common_mg: float = 12.0  # of what all readings of a block share: structure that no state stands for
    common_lo_mg: float = 1.0
    common_hi_mg: float = 30.0
    adapt_after: int = 5  # blocks
    adapt_s: float = 10.0
    adapt_first_s: float = 2.0
    sync_s: float = 0.03
    tilt_rad: float = math.radians(1.0)
    tilt_tau_s: float = 10.0
    least_tilt_rad: float = math.radians(1.2)  # RMS per axis: less may be nothing but noise of the attitude
    own_tilt_doubt: float = 3.0  # times what gyro and accelerometer claim of their tilt: the error goes with the motion
    own_tilt_most_rad: float = math.radians(30.0)  # beyond it the equation is no turn any more
    own_tilt_tau_s: float = 3.0
    own_tilt_joined: float = 2.0  # times the variance it then has against the second opinion
    slow_s: float = 0.3  # between attitudes; beyond it what lies between two is guessed at
    slow_doubt: float = 25.0  # times the variance the bank then claims
    disturbance_mg: float = 1.5
    disturbance_lo_mg: float = 0.5
    disturbance_hi_mg: float = 7.0
    disturbance_tau_s: float = 1.0
    throttle_mg: float = 60.0
    gyro_rads: float = math.radians(0.6)
    delay_s: float = 0.03
    kappa: float = 0.03
    gain: float = 0.005  # of the sensor as a whole: the field it shows is the model's but for this share
    turn_walk_rad: float = math.radians(0.2)  # per square root of a second
    turn_scale: float = 0.01
    doubt_nis: float = 14.0
    temper: float = 0.25
    forget_s: float = 60.0
    prune_every: int = 8
    plain_doubt: float = 9.0  # by how much more the second opinion is doubted where nothing looks like plain iron
    join_apart: float = 3.0  # sigmas between bank and second opinion, for this to compete in the bank
    join_every_s: float = 8.0
    join_behind: float = 2.0  # in log weight
    prune_below: float = 1e-4
    part_at: int = 5  # hypotheses are left of the first model: time for the others
    most_at_first: int = 10  # hypotheses are kept, and the best of each model
    narrow_s: float = 20.0  # of learning; from then on
    most: int = 6
    merge_sigma: float = 0.35
    change_tau_s: float = 1.5
    change_chi2: float = 60.0
    change_disturbance: float = 60.0  # of |d|^2 / sigma^2
    change_nis: float = 12.0  # of single readings, for a second
    change_hold_s: float = 1.0  # a magnet on its way is opened for again once it is there
