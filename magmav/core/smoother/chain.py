"""The least squares of a whole stretch, solved node by node: a forward filter in information form, and back again.

What passes with time (heading, iron, tilt error, disturbance) has a value at each node and is tied to its neighbours by
how time passes (adaptive.process); what stays (field, throttle, soft iron, gyro bias, delay, mounting) is one for all.
Eliminating node after node is the forward information filter, putting back is the fixed-interval smoother of Rauch,
Tung and Striebel (1965), and the sum of the pivots' logarithms is what the evidence of a model needs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from magmav.core.estimators.adaptive import layout as at
from magmav.core.estimators.adaptive.bank import field_covariance
from magmav.core.estimators.adaptive.layout import Array, Index
from magmav.core.estimators.adaptive.tuning import Model, Tuning
from magmav.core.smoother.nodes import Nodes
from magmav.core.smoother.noise import Noise

Field = tuple[float, float, float, float]  # mean and sigma of H and of V, mG

PASSING: Index = np.array([at.ALPHA, *range(at.SIZE)[at.B], *range(at.SIZE)[at.E], *range(at.SIZE)[at.D]])
STAYING: Index = np.setdiff1d(np.arange(at.SIZE), PASSING)
_P, _S = len(PASSING), len(STAYING)
_BACK = np.argsort(np.concatenate((PASSING, STAYING)))
_ALPHA, _B, _E, _D = 0, slice(1, 4), slice(4, 6), slice(6, 9)  # in PASSING
_GYRO = slice(*np.searchsorted(STAYING, (at.G.start, at.G.stop)))
_ANY_ALPHA = 1e-6  # information of a heading that may be any, 1/rad^2
_NO_TIME = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Way:
    """How time passes, one or more accounts of it (c): fades (n - 1, P), ties (n - 1, c, P) : information of steps."""

    fades: Array
    ties: Array
    first: Array  # (P,), information at the first node

    @classmethod
    def of(cls, nodes: Nodes, noise: Noise, walks_mg: Sequence[float], opened_mg: Array, n: Tuning) -> Way:
        """walks_mg : of the iron, per square root of a second.  opened_mg (n - 1,) : sigma of a step on top of that."""
        tilt_rad, tilt_s = nodes.tilt(n)
        tilt = np.where(nodes.lost, 0.0, np.exp(-nodes.dt_s / tilt_s[1:]))
        short = np.exp(-nodes.dt_s / n.disturbance_tau_s)
        fades = np.ones((len(nodes) - 1, _P))
        fades[:, _E], fades[:, _D] = tilt[:, None], short[:, None]
        ties = np.empty((len(nodes) - 1, len(walks_mg), _P))
        ties[..., _ALPHA] = np.where(nodes.lost, 0.0, 1.0 / np.maximum(nodes.turn_rad2, _NO_TIME))[:, None]
        for k, walk in enumerate(walks_mg):
            ties[:, k, _B] = 1.0 / (walk**2 * np.maximum(nodes.dt_s, 1e-3) + opened_mg**2)[:, None]
        ties[..., _E] = _fading(tilt, tilt_rad[1:])[:, None, None]
        ties[..., _D] = _fading(short, noise.disturbance_mg)[:, None, None]
        first = np.empty(_P)
        first[_ALPHA], first[_B] = _ANY_ALPHA, n.prior_iron_mg**-2
        first[_E], first[_D] = tilt_rad[0] ** -2, noise.disturbance_mg**-2
        return cls(fades, ties, first)


def _fading(fade: Array, sigma: Array | float) -> Array:
    out: Array = 1.0 / (np.maximum(1.0 - fade * fade, _NO_TIME) * sigma**2)
    return out


def staying_prior(field: Field, model: Model, n: Tuning) -> tuple[Array, Array]:
    """Mean (S,) and information (S, S) of what stays, before any data."""
    h, h_sigma, v, v_sigma = field
    mean, variance = np.zeros(at.SIZE), np.ones(at.SIZE)
    variance[at.K], variance[at.S], variance[at.G] = n.throttle_mg**2, model.soft_variances(), n.gyro_rads**2
    variance[at.T], variance[at.KAPPA], variance[at.R] = n.delay_s**2, n.kappa**2, n.mounting_rad**2
    information = np.diag(1.0 / variance[STAYING])
    both = field_covariance(h, v, n) - n.model_mg**2 * np.eye(2) + np.diag((h_sigma**2, v_sigma**2))
    information[:2, :2] = np.linalg.inv(both)  # H and V come first
    mean[at.H], mean[at.V] = h, v
    return mean[STAYING], information


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """What the data say under one model.

    passing (n, P), staying (S,) : most likely.  log_evidence : but for what is the same for all models.
    spread (S, S) : covariance of what stays.
    """

    passing: Array
    staying: Array
    spread: Array
    log_evidence: float
    _chain: Chain
    _which: int

    @property
    def path(self) -> Array:
        """(n, SIZE)."""
        out = np.empty((len(self.passing), at.SIZE))
        out[:, PASSING], out[:, STAYING] = self.passing, self.staying
        return out

    def path_at(self, i: int) -> Array:
        """(SIZE,), at one node."""
        out = np.empty(at.SIZE)
        out[PASSING], out[STAYING] = self.passing[i], self.staying
        return out

    def covariance(self, i: int) -> Array:
        """Of the whole state at one node, (SIZE, SIZE)."""
        held = self._chain.held(self._which, i)
        both = np.empty((at.SIZE, at.SIZE))
        both[:_P, _P:] = cross = -held @ self.spread
        both[_P:, :_P] = cross.T
        both[:_P, :_P] = self._chain.own(self._which)[i] - cross @ held.T
        both[_P:, _P:] = self.spread
        out: Array = both[_BACK[:, None], _BACK]
        return out

    def step_covariance(self) -> tuple[Array, Array]:
        """Of how far the iron moves from each node to the next: mean (n - 1, 3) and covariance (n - 1, 3, 3), mG."""
        chain, k = self._chain, self._which
        own, gain = chain.own(k)[:, _B, :][:, :, _B], chain.gains(k)
        cross = (gain[:, _B] @ chain.own(k)[1:])[:, :, _B]
        covariance = own[1:] + own[:-1] - cross - cross.transpose(0, 2, 1)
        held = chain.all_held(k)[:, _B]
        moved = held[1:] - held[:-1]
        covariance += moved @ self.spread @ moved.transpose(0, 2, 1)
        return self.passing[1:, _B] - self.passing[:-1, _B], covariance

    def ties(self) -> Array:
        """Information of the iron's steps, (n - 1,) 1/mG^2."""
        return self._chain.way.ties[:, self._which, _B.start]


class Chain:
    """The nodes eliminated one after the other, for every account of how time passes at once."""

    def __init__(self, nodes: Nodes, info: Array, way: Way) -> None:
        """info : see linear.linear."""
        self.way = way
        n, c = len(nodes), way.ties.shape[1]
        order = np.concatenate((PASSING, STAYING, [at.SIZE]))
        info = info[:, order[:, None], order]
        pivots = np.repeat(info[:, None, :_P, :_P], c, axis=1)
        right = np.empty((n, c, _P, _S + 1))  # of what stays, and of the data
        right[:] = info[:, None, :_P, _P:]
        self._stays = np.repeat(info[None, :, _P:, _P:].sum(1), c, axis=0)  # (c, S + 1, S + 1)
        diagonal = np.einsum("ncii->nci", pivots)
        diagonal[0] += way.first
        diagonal[1:] += way.ties
        diagonal[:-1] += way.fades[:, None] ** 2 * way.ties
        self._turning(nodes, right)
        self._back = way.fades[:, None] * way.ties  # less the entries beside the diagonal
        self._eliminate(pivots, right)
        constant = np.log(np.where(way.ties > 0.0, way.ties, 1.0)).sum((0, 2)) + np.log(way.first).sum()
        self._log_det = constant + np.linalg.slogdet(self._inverse)[1].sum(0)
        self._own: dict[int, Array] = {}

    def _turning(self, nodes: Nodes, right: Array) -> None:
        """The heading turns on by what the gyro's bias adds: alpha' - alpha - g . down - turned is noise."""
        tie = self.way.ties[..., _ALPHA]
        by = np.zeros((len(nodes) - 1, _S + 1))
        by[:, _GYRO], by[:, _S] = nodes.down_s, nodes.turned_rad
        pull = tie[..., None] * by[:, None]
        signs = np.ones(_S + 1)
        signs[:_S] = -1.0  # what stays is on the left, the data on the right
        right[1:, :, _ALPHA] += signs * pull
        right[:-1, :, _ALPHA] -= signs * pull
        both = np.einsum("ic,ia,ib->cab", tie, by, by)
        both[:, :_S, _S] *= -1.0
        both[:, _S, :_S] *= -1.0
        self._stays += both

    def _eliminate(self, pivots: Array, right: Array) -> None:
        n = len(pivots)
        beside = self._back[..., :, None] * self._back[..., None, :]
        column = self._back[..., None]
        inverse, answers = np.empty_like(pivots), np.empty_like(right)
        one = inverse[0] = np.linalg.inv(pivots[0])
        answer = answers[0] = one @ right[0]
        for i in range(1, n):
            one = inverse[i] = np.linalg.inv(pivots[i] - beside[i - 1] * one)
            right[i] += column[i - 1] * answer
            answer = answers[i] = one @ right[i]
        self._stays -= np.einsum("ncpi,ncpj->cij", right, answers, optimize=True)
        for i in range(n - 2, -1, -1):
            answers[i] += inverse[i] @ (column[i] * answers[i + 1])
        self._inverse, self._answers, self._beside = inverse, answers, beside

    def solve(self, which: int, field: Field, model: Model, n: Tuning) -> Solved:
        """Under one account of how time passes and one prior of what stays."""
        mean, prior = staying_prior(field, model, n)
        stays = self._stays[which]
        information = stays[:_S, :_S] + prior
        pull = stays[:_S, _S] + prior @ mean
        spread = np.linalg.inv(information)
        staying = spread @ pull
        passing = self._answers[:, which, :, _S] - self._answers[:, which, :, :_S] @ staying
        misfit = stays[_S, _S] + mean @ prior @ mean - pull @ staying
        logs = np.linalg.slogdet(prior)[1] - np.linalg.slogdet(information)[1]
        evidence = 0.5 * float(self._log_det[which] + logs - misfit)
        return Solved(passing, staying, 0.5 * (spread + spread.T), evidence, self, which)

    def own(self, which: int) -> Array:
        """Covariance of what passes at each node had what stays been known, (n, P, P)."""
        if which not in self._own:
            inverse, beside = self._inverse[:, which], self._beside[:, which]
            out = np.empty_like(inverse)
            one = out[-1] = inverse[-1]
            for i in range(len(out) - 2, -1, -1):
                d = inverse[i]
                one = out[i] = d + d @ (beside[i] * one) @ d
            self._own[which] = out
        return self._own[which]

    def gains(self, which: int) -> Array:
        """What a node takes over from the next, (n - 1, P, P)."""
        out: Array = self._inverse[:-1, which] * self._back[:, which, None, :]
        return out

    def held(self, which: int, i: int) -> Array:
        """By how much what passes at a node moves, against what stays, (P, S)."""
        out: Array = self._answers[i, which, :, :_S]
        return out

    def all_held(self, which: int) -> Array:
        """Of all nodes, (n, P, S)."""
        out: Array = self._answers[:, which, :, :_S]
        return out
