"""The adaptive estimator: a small bank of error-state filters over headings and models, on one measurement equation.

layout       what the state holds
block        a few samples in a row, taken in together
process      how time passes
measurement  the one equation and its Jacobian
bank         hypotheses and weights
answer       what is made of them
robust       wild readings, doubt, and noise as it shows
change       a sudden change of the iron
opinion      what the field's length alone says, joined to it
tuning       every chosen number
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from magmav.core.estimators.adaptive import layout as at
from magmav.core.estimators.adaptive.answer import surprise, without_prior
from magmav.core.estimators.adaptive.bank import Bank
from magmav.core.estimators.adaptive.block import Block, Gathering
from magmav.core.estimators.adaptive.change import ChangeWatch
from magmav.core.estimators.adaptive.layout import Array
from magmav.core.estimators.adaptive.measurement import equation, means, shared_by_all, smear, soft_matrix
from magmav.core.estimators.adaptive.opinion import doubt, joined, known, stale, told
from magmav.core.estimators.adaptive.process import advance
from magmav.core.estimators.adaptive.robust import Stillness, Tilting, WildGate, adapt, between, doubted, squares
from magmav.core.estimators.adaptive.tuning import HARD, MODELS, Tuning
from magmav.core.estimators.twostep import TwostepEstimator, distance
from magmav.core.field import ExpectedField
from magmav.core.rotation import body_from_earth
from magmav.core.threes import inverse3
from magmav.core.types import NO_SHAPING, Estimate, Sample, mat3, vec3

_EYE3 = np.eye(3)
_DOWN = np.diag((0.0, 0.0, 1.0))
_FLOOR_MG = (
    0.5,
    0.5,
    1.0,
)  # lower than others': how much structure the readings have shows in its noise
_BESIDE_MG = 5.0  # what the second opinion may be off beyond twice its sigma, where it competes
_FIELD_APART = 1.2  # who has heard the model cannot be as far from it as who has not
_STRANGEST = 60.0  # of one reading's normalised innovation squared, in its mean


class AdaptiveEstimator:
    """One compass's bank."""

    def __init__(self, tuning: Tuning | None = None, second: bool = True) -> None:
        """second : is a second opinion heard as well?"""
        self.tuning = tuning or Tuning()
        self._bank: Bank | None = None
        self._gathering = Gathering()
        self._wild = WildGate()
        self._still = Stillness()
        self._tilting = Tilting()
        self._change = ChangeWatch(self.tuning)
        self._second = TwostepEstimator() if second else None
        self._own_yaw_rad = 0.0
        self._lost = False
        self._by_hand = False
        self._drive = 0.0  # mean of what k is multiplied with
        self._driven = 0
        self._drive2 = 0.0  # its variance
        self._drives = (0.0, 0.0)  # both, as of the last block
        self._learnt = 0  # blocks, ever
        self._answered: tuple[tuple[object, ...], Callable[..., Estimate]] | None = None  # and what it rests on
        self._told: tuple[Estimate, Array] | None = None  # by the second opinion
        self._samples = self._blocks = 0
        self._residual_mg2 = 0.0
        self._residual_n = 0
        self._structure_mg2 = 0.0  # of what readings in a row share, and nothing explains
        self._nis = 1.0
        self._joined_ago_s = 0.0
        self._axes = 3
        self._own_tilt = False
        self._tilt_every_s = 0.0  # mean time between attitudes
        self._matrix: Array = _EYE3
        self._inverse: Array = _EYE3
        self._model_mg: tuple[float, float] | None = None

    # ------------------------------------------------------------ time

    def step(self, s: Sample) -> None:
        """Learn from one sample, or carry time forward."""
        n, gathering = self.tuning, self._gathering
        if self._by_hand and s.learn and not s.by_hand and self._second is not None:
            self._second = TwostepEstimator()  # what stood about it in the hand does not fly along
        if len(gathering) and (s.gap or not s.learn or not gathering.fits(s)):
            self._learn()
        self._own_yaw_rad += s.yaw_step_rad
        body_from_own = s.body_from_own
        if body_from_own is None:
            body_from_own = body_from_earth(s.roll_rad, s.pitch_rad, self._own_yaw_rad)
        down_b, dt = body_from_own[:, 2], max(s.dt_s, 0.0)
        z = s.mag_b_mg
        if s.shaping is not NO_SHAPING:
            z = s.shaping.matrix @ z + s.shaping.motor_b_mg
        about_down, rate = float(s.rate_b_rads @ down_b) * dt, math.hypot(*s.rate_b_rads.tolist())
        still = s.learn and self._still.step(z, rate, dt) and not len(gathering)
        if still:
            gathering.rests(dt, about_down)
        else:
            walk = n.turn_walk_rad if s.tilt_from == "ATTITUDE" else 4.0 * n.turn_walk_rad
            gathering.passes(dt, down_b, walk**2 * dt + (n.turn_scale * about_down) ** 2)
        if self._second is not None:
            self._second.step(replace(s, learn=False) if still else s)
        self._lost = self._lost or s.gap
        if not s.learn or still or self._wild.step(z, rate * dt):
            return
        self._samples += 1
        self._tilt_every_s += max(1.0 / self._samples, 0.02) * (s.tilt_every_s - self._tilt_every_s)
        drive = self._drive
        if s.throttle is not None:
            drive = s.throttle - 0.5
            self._driven = min(self._driven + 1, 2000)
            self._drive += (drive - self._drive) / self._driven
            self._drive2 += ((drive - self._drive) ** 2 - self._drive2) / self._driven
        if self._bank is None:
            self._bank = self._begun(self._prior(s, z, down_b))
        if self._by_hand and not s.by_hand:
            self._leave_ground(s, z, down_b)
            gathering = self._gathering
        self._by_hand = s.by_hand
        self._tilting.step(down_b)
        if self._model_mg is None and s.model_mg is not None:
            self._model_mg = s.model_mg
            self._bank.tell_field(*s.model_mg, n)
        gathering.add(s, z, *self._tilting.calmed(body_from_own, n.least_tilt_rad), drive)
        if len(gathering) == n.block_readings or gathering.span_s + dt > n.block_s:
            self._learn()

    def _prior(self, s: Sample, z: Array, down_b: Array) -> tuple[float, float, float, float]:
        n = self.tuning
        self._model_mg = s.model_mg
        if s.model_mg is not None:
            return s.model_mg[0], n.model_mg, s.model_mg[1], n.model_mg
        return (*n.blind_h_mg, float(z @ down_b), n.blind_v_mg)

    def _begun(self, field: tuple[float, float, float, float], iron_mg: Array | None = None) -> Bank:
        return Bank.opened(field, self.tuning, iron_mg)

    def _leave_ground(self, s: Sample, z: Array, down_b: Array) -> None:
        """What stood about it while it was turned by hand does not fly along: only where the iron is about stays."""
        if len(self._gathering):
            self._learn()
        assert self._bank is not None
        iron_mg = self._bank.mixture()[0][at.B]
        self._bank = self._begun(self._prior(s, z, down_b), iron_mg)
        self._tilting = Tilting()
        self._gathering = Gathering()
        self._samples = self._blocks = self._residual_n = 0

    # ------------------------------------------------------------ learning

    def _learn(self) -> None:
        """Take in the block that has gathered."""
        self._take_in(self._gathering.close())

    def _take_in(self, block: Block) -> None:
        n, bank = self.tuning, self._bank
        assert bank is not None  # made with the first sample
        if self._lost and self._blocks:  # who has just begun knows no heading anyway
            bank.lose_heading(n)
        self._lost = False
        if block.dt_s > 0.0 and self._blocks:
            bank.x[:, at.ALPHA] += block.turned_rad
            advance(bank, block.dt_s, block.down_s, block.turn_rad2, block.own_tilt_rad, n)
        self._update(bank, block)
        self._blocks += 1
        self._learnt += 1
        self._drives = self._drive, self._drive2
        self._joined_ago_s += block.dt_s
        if self._blocks % n.prune_every:
            return
        if self._joined_ago_s > n.join_every_s:
            self._compete(block)
        bank, narrow = self._bank, self._blocks * n.block_s > n.narrow_s
        assert bank is not None
        most = n.most if narrow else n.most_at_first
        if len(bank) > len(MODELS):
            bank.tidy(n, most)
        if not bank.parted and (narrow or len(bank) <= n.part_at):
            bank.part(n)
            bank.tidy(n, most)  # who has not watched for long has seen no drift: one such hypothesis will do

    def _compete(self, block: Block) -> None:
        """Where the second opinion is another, let it compete: the bank may have gone astray."""
        bank, second = self._bank, self._second
        said = None if second is None else second.opinion(None)
        if bank is None or second is None or said is None or self._is_stale():
            return
        mean, covariance = bank.mixture()
        take, theirs_mg2 = self._take(), known(said.covariance_mg2) + self._motors_mg2(mean)
        apart = distance(take @ mean - said.hard_iron_b_mg, take @ covariance @ take.T, theirs_mg2)
        if apart > self.tuning.join_apart:
            self._joined_ago_s = 0.0
            bank.join(
                said.hard_iron_b_mg,
                2.0 * np.sqrt(np.diag(said.covariance_mg2)) + _BESIDE_MG,
                block,
                self._model_mg,
                self.tuning,
            )

    def _update(self, bank: Bank, block: Block) -> None:
        n, k, count, size = self.tuning, block.axes, len(bank), len(block)
        self._axes, self._own_tilt = k, block.own_tilt_rad is not None
        if self._matrix is not block.shaping.matrix:
            self._matrix = block.shaping.matrix
            self._inverse = np.asarray(np.linalg.inv(self._matrix), dtype=np.float64)
        y, j, of_u = equation(bank.x, block)
        nu = (block.z - y)[..., :k]
        flat = nu.reshape(count, size * k)
        rows = j[:, :, :k].reshape(count, size * k, at.SIZE)
        jp = rows @ bank.p
        expected = jp @ rows.transpose(0, 2, 1)
        expected += bank.common_mg2[:, None, None] * shared_by_all(size, k)
        expected.reshape(count, -1)[:, :: size * k + 1] += bank.white_mg2[:, None]
        own = np.einsum("kiaib->kiab", expected.reshape(count, size, k, size, k))
        own += smear(of_u, block, n.sync_s)[..., :k, :k]
        strange = doubted(own, nu, bank.white_mg2 + bank.common_mg2, n.doubt_nis)
        log_likelihood, moved = bank.learn(expected, jp, flat)
        bank.upright()
        bank.weigh(log_likelihood, block.dt_s, n)
        best = int(bank.log_weight.argmax())
        by = means(size, k)
        mean, variance = flat @ by, (expected @ by * by).sum(1)
        white = between(mean / np.sqrt(variance), -4.0, 4.0)
        lone = squares(own[best], nu[best]) if strange is None else strange[best]
        strangeness = sum(min(one, _STRANGEST) for one in lone.tolist()) / (k * size)
        self._nis += min((2.5 if strangeness > self._nis else 1.0) * block.dt_s, 0.5) * (strangeness - self._nis)
        if self._blocks > n.adapt_after:
            adapt(bank, nu - mean[:, None], white, bank.common_mg2[:, None] / variance, block.dt_s, n)
            disturbance = math.hypot(*bank.x[best, at.D].tolist()) / float(bank.disturbance_mg[best])
            like = float(bank.product[best]) / max(float(bank.square[best]), 0.1)
            changed = self._change.step(white[best], mean[best], like, disturbance**2, self._nis, block.dt_s)
            if changed and not self._by_hand:  # in the hand something else is near, more likely than on it
                self._open(bank, block)
        else:
            self._change.since_s += block.dt_s
        self._structure_mg2 = float(bank.common_mg2[best])
        left = nu[best] - (rows[best] @ moved[best]).reshape(size, k) + bank.x[best, at.D][:k]
        self._residual_n += size
        weight = size / min(self._residual_n, 500)
        self._residual_mg2 += weight * (float((left * left).sum()) / (k * size) - self._residual_mg2)

    def _open(self, bank: Bank, block: Block) -> None:
        """The iron has changed. What else is known stays; where that is not even the field, begin anew."""
        n = self.tuning
        self._residual_n = 0
        self._change.open(bank)
        if self._model_mg is None and math.sqrt(bank.mixture()[1][at.H, at.H]) > n.blind_h_mg[1] * n.field_known:
            field = (*n.blind_h_mg, float(block.z[-1] @ block.body_from_own[-1, :, 2]), n.blind_v_mg)
            self._bank = self._begun(field)
            self._blocks = 0

    # ------------------------------------------------------------ answer

    def estimate(self, expected: ExpectedField | None) -> Estimate | None:
        """Belief now."""
        if self._bank is None or self._samples < 10:
            return None
        said = None if self._second is None else self._second.opinion(expected)
        level = self._tilting.rms_rad < self.tuning.least_tilt_rad  # it may be the attitude's own noise that tilts
        rests_on = (self._learnt, said, self._is_stale(), level)
        if self._answered is None or self._answered[0] != rests_on:
            self._answered = rests_on, self._answer(self._bank, expected, level)
        return self._answered[1](samples=self._samples)

    def __getstate__(self) -> dict[str, Any]:
        """What was answered since the last block is made again when asked."""
        return self.__dict__ | {"_answered": None, "_told": None}

    def _answer(self, bank: Bank, expected: ExpectedField | None, level: bool) -> Callable[..., Estimate]:
        """All but how many samples it rests on. level : has it hardly tilted?"""
        mean, covariance = bank.mixture()
        take = self._take()
        pulled = covariance @ take.T
        iron_mg2 = own_mg2 = take @ pulled
        if self._model_mg is not None:
            field_mg2 = covariance[at.H : at.V + 1, at.H : at.V + 1]
            own_mg2 = without_prior(iron_mg2, pulled[at.H : at.V + 1], field_mg2, *self._model_mg, self.tuning)
        if level:
            unknown = _DOWN * self.tuning.blind_v_mg**2
            own_mg2 = own_mg2 + unknown
            if self._model_mg is None:
                iron_mg2 = iron_mg2 + unknown
                pulled[at.B] += unknown
        slow = self._tilt_every_s > self.tuning.slow_s
        if slow:
            pulled, iron_mg2, own_mg2 = (self.tuning.slow_doubt * one for one in (pulled, iron_mg2, own_mg2))
        field_apart = 0.0
        if self._model_mg is not None:
            field_apart = surprise(float(mean[at.H]), float(mean[at.V]), self._model_mg, self.tuning)
        mean, iron_mg2, own_mg2, apart = self._joined(mean, take, pulled, iron_mg2, own_mg2, expected)
        soft = inverse3(_EYE3 + soft_matrix(mean[at.S]))
        if slow or self._own_tilt:  # a wrong tilt looks like soft iron to the bank
            said = None if self._second is None else self._second.opinion(expected)
            if said is not None and not self._is_stale():
                soft = said.soft_iron_b
            elif slow:
                soft = _EYE3
        return partial(
            Estimate,
            hard_iron_b_mg=vec3(take @ mean, "hard iron"),
            covariance_mg2=iron_mg2,
            own_sigma_mg=vec3(np.sqrt(own_mg2.diagonal()), "sigma"),
            horizontal_mg=float(mean[at.H]),
            down_mg=float(mean[at.V]),
            residual_mg=math.sqrt(self._residual_mg2 + self._structure_mg2),
            step_nis=self._nis,
            changed_ago_s=self._change.since_s,
            delay_s=float(mean[at.T]),
            soft_iron_b=mat3(soft, "soft iron"),
            says_b=(True, True, self._axes == 3),
            throttle_b_mg=vec3(mean[at.K], "throttle"),
            throttle_mean=self._drives[0] + 0.5,
            floor_mg=_FLOOR_MG,
            apart=max(apart, _FIELD_APART * field_apart),
        )

    def _is_stale(self) -> bool:
        return self._second is not None and stale(self._second, self._change.since_s)

    def _take(self) -> Array:
        """What makes of a state the iron at mean throttle, (3, n)."""
        take = np.zeros((3, at.SIZE))
        take[:, at.B], take[:, at.K] = _EYE3, self._drives[0] * self._inverse
        return take

    def _motors_mg2(self, mean: Array) -> Array:
        """Variance of the motors' field, of which the second opinion knows nothing, (3, 3)."""
        return self._drives[1] * float(mean[at.K] @ mean[at.K]) * _EYE3

    def _joined(
        self, mean: Array, take: Array, pulled: Array, iron_mg2: Array, own_mg2: Array, expected: ExpectedField | None
    ) -> tuple[Array, Array, Array, float]:
        """State with the second opinion, covariance of the iron and that without the model, and sigmas between both.

        take (3, n) : the iron of a state.  pulled (n, 3) : covariance of state and iron.
        """
        bank, said = self._bank, None if self._second is None else self._second.opinion(expected)
        if bank is None or said is None:
            return mean, iron_mg2, own_mg2, 0.0
        off = said.hard_iron_b_mg - take @ mean
        apart = distance(off, iron_mg2, said.covariance_mg2)
        if self._is_stale():
            return mean, iron_mg2, own_mg2, apart
        much, less = doubt(apart), 1.0
        if self._own_tilt:
            less = self.tuning.own_tilt_joined
        else:
            much *= 1.0 + self.tuning.plain_doubt * (1.0 - bank.share(HARD)) ** 2
        if self._told is None or self._told[0] is not said:
            self._told = said, told(said)
        theirs_mg2 = much * self._told[1] + self._motors_mg2(mean)
        (iron_mg2, own_mg2), pull = joined(np.array((iron_mg2, own_mg2)), theirs_mg2, less)
        return mean + pulled @ (pull[0] @ off), iron_mg2, own_mg2, apart
