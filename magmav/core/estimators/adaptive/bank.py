"""The hypotheses and their weights: begun over all headings, weighed by how well they foretell, merged and dropped."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from magmav.core.estimators.adaptive import layout as at
from magmav.core.estimators.adaptive.block import Block
from magmav.core.estimators.adaptive.layout import Array, Index
from magmav.core.estimators.adaptive.tuning import FIRST, MODELS, Model, Tuning
from magmav.core.packing import upper, whole
from magmav.core.rotation import TAU

_COLUMNS: tuple[str, ...] = ("x", "p", "model", "log_weight", "prior", "walk_mg")
_ASTRAY = 5.0  # of the log weight, each time
_LEAST = -15.0  # from there a hypothesis that foretells better is back within seconds
_COLUMNS += ("white_mg2", "common_mg2", "disturbance_mg", "square", "product", "last")


def field_covariance(h_mg: float, v_mg: float, n: Tuning) -> Array:
    """Of the model's (H, V) as this sensor shows them, (2, 2) mG^2: the model's error, and the sensor's gain."""
    both = np.array((h_mg, v_mg))
    out: Array = n.model_mg**2 * np.eye(2) + n.gain**2 * np.outer(both, both)
    return out


class Bank:
    """All hypotheses side by side: x (K, n), p (K, n, n), and for each its model, log weight and noise."""

    def __init__(self, x: Array, p: Array, model: Index, log_weight: Array, n: Tuning) -> None:
        self.x, self.p, self.model, self.log_weight = x, p, model, log_weight
        k = len(x)
        self.white_mg2 = np.full(k, n.white_mg**2)  # variance of one reading's own noise
        self.common_mg2 = np.full(k, n.common_mg**2)  # of what all readings of a block share
        self.disturbance_mg = np.full(k, n.disturbance_mg)
        self.square, self.product = (
            np.ones(k),
            np.zeros(k),
        )  # of the whitened mean innovation, and with its neighbour
        self.last = np.zeros((k, 3))  # the one before
        self.seen_s = 0.0
        self.walk_mg = np.array([MODELS[m].iron_walk_mg for m in model])  # per square root of a second
        self.prior = np.log([MODELS[m].weight for m in model])

    @staticmethod
    def opened(field: tuple[float, float, float, float], n: Tuning, iron_mg: Array | None = None) -> Bank:
        """One filter per heading, of the first model alone: ``part`` adds the others.

        field : mean and sigma of H and of V, mG.  iron_mg : (3,) where the iron may be looked for first; it may be
        n.ground_mg off.
        """
        h, h_sigma, v, v_sigma = field
        k, one = n.yaws, MODELS[FIRST]
        x, p = np.zeros((k, at.SIZE)), np.zeros((k, at.SIZE, at.SIZE))
        x[:, at.ALPHA] = np.arange(k) * TAU / k
        x[:, at.H], x[:, at.V] = h, v
        diagonal = p.reshape(k, -1)[:, :: at.SIZE + 1]
        diagonal[:, at.ALPHA] = (0.5 * TAU / k) ** 2
        diagonal[:, at.B] = n.prior_iron_mg**2
        if iron_mg is not None:
            x[:, at.B] = iron_mg
            diagonal[:, at.B] = n.ground_mg**2
        diagonal[:, at.H], diagonal[:, at.V] = h_sigma**2, v_sigma**2
        p[:, at.H : at.V + 1, at.H : at.V + 1] += field_covariance(h, v, n) - n.model_mg**2 * np.eye(2)
        diagonal[:, at.E] = n.tilt_rad**2
        diagonal[:, at.D] = n.disturbance_mg**2
        diagonal[:, at.K] = n.throttle_mg**2
        diagonal[:, at.R] = n.mounting_rad**2
        diagonal[:, at.S] = one.soft_variances()
        diagonal[:, at.G] = n.gyro_rads**2
        diagonal[:, at.T] = n.delay_s**2
        diagonal[:, at.KAPPA] = n.kappa**2
        return Bank(x, p, np.full(k, FIRST), np.full(k, math.log(one.weight / k)), n)

    @staticmethod
    def begun(field: tuple[float, float, float, float], n: Tuning, iron_mg: Array | None = None) -> Bank:
        """One filter per heading and model; field and iron_mg as ``opened`` has them."""
        out = Bank.opened(field, n, iron_mg)
        out.part(n)
        return out

    @property
    def parted(self) -> bool:
        """Are there other models than the first?"""
        return bool((self.model != FIRST).any())

    def part(self, n: Tuning) -> None:
        """Add the other models: what the first would believe, had it known from the start how large S may be.

        Their priors are as the first one's times a normal density in S, N(0, R), which may as well come in last; what
        the data say of them against it is the mean of that density over what it believes now (Dickey 1971). Where they
        allow for more, R is negative: the prior's information is taken back.
        """
        rows = np.flatnonzero(self.model == FIRST)
        first, parts = MODELS[FIRST], []
        for m, one in enumerate(MODELS):
            part = self.kept(rows)
            own, theirs = one.soft_variances(), first.soft_variances()
            if not np.array_equal(own, theirs):
                part.log_weight += n.temper * part._told(own * theirs / (theirs - own), theirs / own)
            part.log_weight += math.log(one.weight / first.weight)
            part.model = np.full(len(rows), m)
            part.walk_mg, part.prior = np.full(len(rows), one.iron_walk_mg), np.full(len(rows), math.log(one.weight))
            parts.append(part)
        for name in _COLUMNS:
            setattr(self, name, np.concatenate([getattr(part, name) for part in parts]))

    def _told(self, r: Array, shares: Array) -> Array:
        """Take in that S is N(0, r), (6,); the log of the evidence for it (K,).

        shares (6,) : of the priors' variances.
        """
        expected = self.p[:, at.S, at.S] + np.diag(r)
        gain = self.p[:, :, at.S] @ np.linalg.inv(expected)
        off = -self.x[:, at.S]
        nis = (off * np.linalg.solve(expected, off[:, :, None])[:, :, 0]).sum(1)
        self.x = self.x + (gain @ off[:, :, None])[:, :, 0]
        p = self.p - gain @ self.p[:, at.S, :]
        self.p = 0.5 * (p + p.transpose(0, 2, 1))
        return np.asarray(0.5 * (np.log(np.abs(shares * r)).sum() - np.linalg.slogdet(expected)[1] - nis))

    def join(
        self, iron_mg: Array, sigma_mg: Array, block: Block, model_mg: tuple[float, float] | None, n: Tuning
    ) -> None:
        """Let somebody else's iron, (3,) and its sigmas, compete: one hypothesis per model that is here begins there.

        The last reading then says where north is and, without a model, how strong the field.
        """
        u = block.z[-1] - block.shaping.matrix @ iron_mg
        north, east, down = (u @ block.body_from_own[-1]).tolist()
        doubt_mg = float(np.linalg.norm(sigma_mg))
        blind = (math.hypot(north, east), doubt_mg, down, doubt_mg)
        field = blind if model_mg is None else (model_mg[0], n.model_mg, model_mg[1], n.model_mg)
        new = (Bank.begun if self.parted else Bank.opened)(field, replace(n, yaws=1), iron_mg)
        diagonal = np.einsum("kii->ki", new.p)
        diagonal[:, at.B] = sigma_mg**2
        new.x[:, at.ALPHA] = math.atan2(east, north)
        diagonal[:, at.ALPHA] = min(doubt_mg / max(blind[0], doubt_mg), 1.0) ** 2
        best = float(self.log_weight.max())
        new.log_weight += best - n.join_behind
        for name in _COLUMNS:
            setattr(self, name, np.concatenate((getattr(self, name), getattr(new, name))))

    def lose_heading(self, n: Tuning) -> None:
        """Any heading again: the best of the first model goes on from every direction, with all else that it knows."""
        w = np.where(self.model == FIRST, self.log_weight, -np.inf)
        self.keep(np.full(n.yaws_again, int(np.argmax(w))))
        self.log_weight = np.zeros(n.yaws_again)
        self.x[:, at.ALPHA] += np.arange(n.yaws_again) * TAU / n.yaws_again
        self.p[:, at.ALPHA, :] = self.p[:, :, at.ALPHA] = 0.0
        self.p[:, at.ALPHA, at.ALPHA] = (0.5 * TAU / n.yaws_again) ** 2
        self.x[:, at.E] = self.p[:, at.E, :] = self.p[:, :, at.E] = 0.0  # it was about axes that are lost
        np.einsum("kii->ki", self.p)[:, at.E] = n.tilt_rad**2

    def doubt_iron(self, sigma_mg: float) -> None:
        """What was learnt of the iron may be off by so much more; the disturbance is part of it from now on."""
        self.x[:, at.B] += self.x[:, at.D]
        self.x[:, at.D] = 0.0
        diagonal = np.einsum("kii->ki", self.p)
        diagonal[:, at.B] += sigma_mg**2

    def tell_field(self, h_mg: float, v_mg: float, n: Tuning) -> None:
        """The world model's field, once a position is known: a measurement of H and V."""
        hv = slice(at.H, at.V + 1)
        both = np.array((h_mg, v_mg))
        expected = self.p[:, hv, hv] + field_covariance(h_mg, v_mg, n)
        gain = self.p[:, :, hv] @ np.linalg.inv(expected)
        self.x += (gain @ (both - self.x[:, hv])[:, :, None])[:, :, 0]
        self.p -= gain @ self.p[:, hv, :]
        self.p = 0.5 * (self.p + self.p.transpose(0, 2, 1))

    def learn(self, expected: Array, jp: Array, nu: Array) -> tuple[Array, Array]:
        """Kalman's update. The log likelihood (K,), but for a constant, and by how much x moved, (K, n).

        nu (K, m) : innovations.  expected (K, m, m) : their covariance.  jp (K, m, n) : Jacobian times p.
        With expected = L L' all that is wanted is in the products of the columns of L^-1 (J P, nu).
        """
        root = np.linalg.cholesky(expected)
        white = np.linalg.solve(root, np.concatenate((jp, nu[:, :, None]), 2))
        products = white.transpose(0, 2, 1) @ white
        moved: Array = products[:, :-1, -1]
        self.x += moved
        p = self.p - products[:, :-1, :-1]
        self.p = 0.5 * (p + p.transpose(0, 2, 1))  # rounding must not grow into asymmetry
        log_det = np.log(root.reshape(len(root), -1)[:, :: root.shape[1] + 1]).sum(1)
        return -0.5 * products[:, -1, -1] - log_det, moved

    def upright(self) -> None:
        """A level field of negative strength points the other way: the same, said as everybody says it."""
        if self.x[:, at.H].min() < 0.0:
            over = self.x[:, at.H] < 0.0
            self.x[over, at.H] *= -1.0
            self.x[over, at.ALPHA] += math.pi
            self.p[over, at.H, :] *= -1.0
            self.p[over, :, at.H] *= -1.0

    def __len__(self) -> int:
        return len(self.x)

    def __getstate__(self) -> dict[str, Any]:
        """A covariance is symmetric to the last bit: half of it is enough."""
        return self.__dict__ | {"p": upper(self.p)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self.p = whole(state["p"], at.SIZE)

    def weights(self) -> Array:
        """(K,) that add to one."""
        w = np.exp(self.log_weight - self.log_weight.max())
        return np.asarray(w / w.sum())

    def share(self, model: Model) -> float:
        """How much one model is believed."""
        best, wanted = float(self.log_weight.max()), MODELS.index(model)
        w = [math.exp(one - best) for one in self.log_weight.tolist()]
        return sum(one for one, m in zip(w, self.model.tolist(), strict=True) if m == wanted) / sum(w)

    def kept(self, rows: Index) -> Bank:
        """A bank of these alone."""
        out = Bank.__new__(Bank)
        out.__dict__ |= self.__dict__
        out.keep(rows)
        return out

    def keep(self, rows: Index) -> None:
        """Only these, in this order."""
        for name in _COLUMNS:
            setattr(self, name, getattr(self, name)[rows])

    def weigh(self, log_likelihood: Array, dt_s: float, n: Tuning) -> None:
        """Better foretold, more believed; old merit fades, so that a model can come back."""
        fade = math.exp(-dt_s / n.forget_s)
        parts = self.log_weight.tolist(), self.prior.tolist(), log_likelihood.tolist(), self.x[:, at.S].tolist()
        weight = [
            fade * was + (1.0 - fade) * prior + n.temper * now - (_ASTRAY if max(map(abs, s)) > n.soft_most else 0.0)
            for was, prior, now, s in zip(*parts, strict=True)
        ]
        best = max(weight)
        self.log_weight = np.array([max(one - best, _LEAST) for one in weight])

    def tidy(self, n: Tuning, most: int) -> None:
        """Drop what is not believed, merge what has become the same; the best of each model stays, and few others."""
        w = self.weights()
        order = np.argsort(-w, kind="stable")
        kept: list[int] = []
        for i in order:
            same = [j for j in kept if self.model[j] == self.model[i]]
            if not same:
                kept.append(int(i))
                continue
            if w[i] < n.prune_below * w[order[0]] or len(kept) >= most:
                continue
            twin = next((j for j in same if self._alike(int(i), j, n.merge_sigma)), None)
            if twin is None:
                kept.append(int(i))
            else:
                self.log_weight[twin] = np.logaddexp(self.log_weight[twin], self.log_weight[i])
        self.keep(np.array(sorted(kept)))

    def _alike(self, i: int, j: int, line: float) -> bool:
        sigma = np.sqrt(np.diagonal(self.p[j]))
        away = math.remainder(self.x[i, 0] - self.x[j, 0], TAU)
        iron = np.abs(self.x[i, at.B] - self.x[j, at.B])
        return abs(away) < line * sigma[0] + 1e-3 and bool((iron < line * sigma[at.B] + 0.5).all())

    def mixture(self) -> tuple[Array, Array]:
        """Mean (n,) and covariance (n, n) of all together; alpha the short way round."""
        w = self.weights()
        x = self.x.copy()
        best = int(np.argmax(w))
        x[:, 0] = x[best, 0] + (x[:, 0] - x[best, 0] + math.pi) % TAU - math.pi
        mean: Array = w @ x
        away = x - mean
        covariance: Array = (w @ self.p.reshape(len(w), -1)).reshape(at.SIZE, at.SIZE) + (away.T * w) @ away
        return mean, covariance
