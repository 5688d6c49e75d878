# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Ticks are the executor's or the runtime's, never both."""

from typing import Any

import pytest

from tsobs_ros.nodes.ticker import Ticker

PERIOD = 0.005


class Bench:
    """A ticker, and a clock of executor turns beside it."""

    def __init__(self, ros: Any) -> None:
        self.ros = ros
        self.ticks = self.turns = 0
        node = ros.node("ticking")
        self.ticker = Ticker(node, PERIOD, self._on_tick)
        node.create_timer(PERIOD, self._on_turn)

    def _on_tick(self) -> None:
        self.ticks += 1

    def _on_turn(self) -> None:
        self.turns += 1

    def ticks_of_the_executor(self) -> int:
        """Return how often the executor ticks in twenty periods."""
        ticks, turns = self.ticks, self.turns
        self.ros.spin_until(lambda: self.turns >= turns + 20)
        return self.ticks - ticks

    def take_over_until(self, ticks: int) -> None:
        """Do what the runtime does, without its sleep."""
        self.ticker.take_over()
        while self.ticks < ticks:
            assert 0 <= self.ticker.run_if_due() <= PERIOD * 1e9


@pytest.fixture
def bench(ros: Any) -> Bench:
    return Bench(ros)


def test_only_a_started_ticker_ticks(bench: Bench) -> None:
    assert bench.ticks_of_the_executor() == 0
    assert not bench.ticker.may_be_taken_over
    bench.ticker.start()
    assert bench.ticker.may_be_taken_over
    assert bench.ticks_of_the_executor() > 3
    bench.ticker.stop()
    assert bench.ticks_of_the_executor() == 0


def test_taken_over_ticks_are_not_the_executors(bench: Bench) -> None:
    bench.ticker.start()
    bench.take_over_until(5)
    assert bench.ticks_of_the_executor() == 0
    bench.ticker.give_back()
    assert bench.ticks_of_the_executor() > 3


def test_a_stop_ends_ticks_that_were_taken_over(bench: Bench) -> None:
    bench.ticker.start()
    bench.take_over_until(1)
    bench.ticker.stop()
    bench.ticker.give_back()
    assert bench.ticks_of_the_executor() == 0
    bench.ticker.start()
    assert bench.ticks_of_the_executor() > 3
