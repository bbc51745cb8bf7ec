"""Two banks at one moment, one that knows what came before and one that knows what came after, made into one.

The two-filter smoother (Fraser and Potter 1969) for mixtures. With P0, x0 what the later bank began with, each pair of
hypotheses of one model becomes
    P^-1 = Pf^-1 + (Pb^-1 - P0^-1),    P^-1 x = Pf^-1 xf + (Pb^-1 xb - P0^-1 x0)
DEVIATES: the paper's backward filter begins with no information at all, so nothing is taken out; ours begins with the
same prior as the forward one, which would count twice. A pair weighs what its two sides weigh, over its model's own
weight, times the overlap of the two, tempered as the banks' own likelihoods are.
"""

from __future__ import annotations

import numpy as np

from magmav.core.estimators.adaptive import layout as at
from magmav.core.estimators.adaptive.bank import Bank
from magmav.core.estimators.adaptive.layout import Array, Index
from magmav.core.rotation import TAU

_LEAST = 1e-4  # a hypothesis less likely than this, against the best, is not carried along
_NOTHING = 1e-9  # information, in units of the prior's, that is none
# What both sides speak of. The tilt's error and the disturbance of the moment are gone seconds later: each side has its
# own, and they stay out.
SHARED: Index = np.array([i for i in range(at.SIZE) if not at.E.start <= i < at.D.stop])
_ALPHA = 0  # in SHARED
_AGAINST_TIME = np.where((at.G.start <= SHARED) & (at.G.stop > SHARED), -1.0, 1.0)


def noted(bank: Bank) -> Bank:
    """A copy of what is believed now: the likely hypotheses, and the best of each model."""
    w = bank.weights()
    kept = w > _LEAST * w.max()
    kept[[max(np.flatnonzero(bank.model == m), key=lambda i: w[i]) for m in np.unique(bank.model)]] = True
    return bank.kept(np.flatnonzero(kept))


def product(before: Bank, after: Bank, begun: Bank, temper: float, heading: bool = True) -> Bank:
    """The belief with both sides known, as a bank to ask for its ``mixture``.

    after : carried to the moment of ``before``; time ran backwards for it, so its gyro bias has the other sign.
    begun : a bank as ``after`` was begun.  temper : of the overlap's logarithm.
    heading : False where the own frame was lost in between: then the two azimuths have nothing to do with each other.
    """
    parts = [
        _pairs(before, after, begun, m, temper, heading) for m in np.unique(before.model) if (after.model == m).any()
    ]
    x, p, log_weight, model = (np.concatenate(one) for one in zip(*parts, strict=True))
    likely = np.flatnonzero(log_weight > log_weight.max() + np.log(_LEAST))
    out = before.kept(np.arange(0))
    out.model, out.log_weight = model[likely], log_weight[likely] - log_weight.max()
    out.x, out.p = np.zeros((len(likely), at.SIZE)), np.zeros((len(likely), at.SIZE, at.SIZE))
    out.x[:, SHARED] = x[likely]
    out.p[:, SHARED[:, None], SHARED] = p[likely]
    return out


def _pairs(
    before: Bank, after: Bank, begun: Bank, model: int, temper: float, heading: bool
) -> tuple[Array, Array, Array, Index]:
    """All pairs of one model: x (F B, n), p (F B, n, n), log weight and model (F B,), n of SHARED.

    Units are the prior's sigmas, so that no inverse sees numbers of different size; the origin is the forward mean.
    """
    f, b = np.flatnonzero(before.model == model), np.flatnonzero(after.model == model)
    first = int(np.flatnonzero(begun.model == model)[0])
    n = len(SHARED)
    scale = np.sqrt(np.diagonal(begun.p[first])[SHARED])
    scale[_ALPHA] = 1.0
    both = scale[:, None] * scale
    cut = SHARED[:, None], SHARED
    signs = _AGAINST_TIME[:, None] * _AGAINST_TIME
    pf = before.p[f][:, *cut] / both
    xf, xb, x0 = before.x[f][:, SHARED], after.x[b][:, SHARED] * _AGAINST_TIME, begun.x[first][SHARED]
    keep = slice(1, None) if not heading else slice(None)
    info_b, size_b = _information(after.p[b][:, *cut] * signs / both, keep)
    info_0, size_0 = _information(begun.p[first][cut][None] / both, slice(1, None))  # any heading
    value, vector = np.linalg.eigh(info_b - info_0)
    value = np.where(value > _NOTHING, value, 0.0)  # less than nothing was learnt: a doubt wider than the prior
    more = (vector * value[:, None, :]) @ vector.transpose(0, 2, 1)  # (B, n, n): what came after adds
    away = (xb[None] - xf[:, None]) / scale  # (F, B, n)
    away[..., _ALPHA] = (away[..., _ALPHA] + np.pi) % TAU - np.pi
    off = (x0 - xf) / scale  # (F, n)
    pull = np.einsum("bij,fbj->fbi", info_b, away) - (off @ info_0[0])[:, None]
    pull = np.einsum("bij,fbj->fbi", vector, np.einsum("bji,fbj->fbi", vector, pull) * (value > 0.0))
    shrink = np.linalg.inv(np.eye(n) + pf[:, None] @ more[None])  # (F, B, n, n)
    p = shrink @ pf[:, None]
    p = 0.5 * (p + p.swapaxes(2, 3))
    moved = np.einsum("fbij,fbj->fbi", p, pull)
    overlap = np.linalg.slogdet(shrink)[1] + size_b[None] - size_0 + (pull * moved).sum(2)
    overlap -= np.einsum("fbi,bij,fbj->fb", away, info_b, away)
    overlap += np.einsum("fi,ij,fj->f", off, info_0[0], off)[:, None]
    weight = before.log_weight[f][:, None] + after.log_weight[b] - before.prior[f][:, None] + temper * 0.5 * overlap
    x = xf[:, None] + moved * scale
    return x.reshape(-1, n), (p * both).reshape(-1, n, n), weight.ravel(), np.full(weight.size, model)


def _information(p: Array, keep: slice) -> tuple[Array, Array]:
    """Inverses of (K, n, n), nothing known of what is not kept, and the logarithms of their determinants (K,)."""
    out = np.zeros_like(p)
    inverse = np.linalg.inv(p[:, keep, keep])
    out[:, keep, keep] = 0.5 * (inverse + inverse.transpose(0, 2, 1))
    return out, -np.linalg.slogdet(p[:, keep, keep])[1]
