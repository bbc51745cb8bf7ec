"""READY only where it stood for a second, and while the readings fit as well as they lately did."""

from __future__ import annotations

import pytest

from magmav.core.steadiness import STOOD_NS, WORSE, WORSE_MG, Stood, Worsening

S = 1_000_000_000


def test_what_is_so_for_less_than_a_second_has_not_stood() -> None:
    stood = Stood()
    assert [stood.step(t * S // 5, so=True) for t in range(7)] == [False] * 5 + [True] * 2
    assert not stood.step(2 * S, so=False)
    assert not stood.step(2 * S + 1, so=True)  # from the beginning again
    assert stood.step(3 * S + 1, so=True)


def test_a_clock_that_goes_back_begins_anew() -> None:
    stood = Stood()
    stood.step(100 * S, so=True)
    assert not stood.step(5 * S, so=True)
    assert stood.step(5 * S + STOOD_NS, so=True)


@pytest.mark.parametrize("residual_mg", [0.5, 8.0, 30.0])
def test_a_fit_is_worse_from_half_as_much_again_on(residual_mg: float) -> None:
    line = WORSE * residual_mg + WORSE_MG
    for now_mg, worse in ((0.99 * line, False), (1.02 * line, True)):
        worsening = Worsening()
        assert not any(worsening.step(t * S // 5, residual_mg) for t in range(50))
        assert worsening.step(10 * S, now_mg) is worse


def test_a_fit_that_stays_worse_is_the_usual_one_after_a_minute_or_so() -> None:
    worsening = Worsening()
    worsening.step(0, 10.0)
    told = [worsening.step(t * S // 5, 20.0) for t in range(1, 5 * 120)]
    assert all(told[: 5 * 5])
    lasts_s = sum(told) / 5.0
    # 10 + 10 (1 - exp(-t / 60)) grows to (20 - 1) / 1.5 = 12.67
    assert lasts_s == pytest.approx(18.6, abs=0.5)
    assert told == sorted(told, reverse=True)


def test_a_fit_that_gets_better_is_the_line_at_once() -> None:
    worsening = Worsening()
    worsening.step(0, 30.0)
    assert not worsening.step(S, 5.0)
    assert worsening.step(S + 1, 10.0)
