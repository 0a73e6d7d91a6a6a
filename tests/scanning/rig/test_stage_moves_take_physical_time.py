"""Motion of the emulated stage against the closed form of a trapezoidal move."""

from __future__ import annotations

import math

import pytest

from scanning.rig.simulated.motion import Block, Motion

PER_MM = 2000


def move(start_mm: float, end_mm: float, speed: float = 10.0, accel: float = 200.0) -> Block:
    sign = math.copysign(1.0, end_mm - start_mm)
    start, end = round(start_mm * PER_MM), round(end_mm * PER_MM)
    return Block((start, 0, 0), (end, 0, 0), abs(end_mm - start_mm), (sign, 0.0, 0.0), speed, accel)


def run_dry(motion: Motion) -> float:
    last = 0.0
    while (due := motion.next_event()) is not None:
        motion.finish_due(due)
        last = due
    return last


@pytest.mark.parametrize(
    ("length_mm", "seconds"),
    [(0.00833, 2 * math.sqrt(0.00833 / 200)), (0.5, 2 * math.sqrt(0.5 / 200)), (20.0, 20 / 10 + 10 / 200)],
)
def test_a_move_takes_what_acceleration_and_speed_allow(length_mm: float, seconds: float) -> None:
    motion = Motion()
    motion.add(move(0, length_mm), 0.0)
    assert run_dry(motion) == pytest.approx(seconds, rel=1e-9)
    assert motion.position(99.0) == (round(length_mm * PER_MM), 0, 0)


def test_queued_moves_in_one_direction_are_passed_at_full_speed() -> None:
    motion = Motion()
    for k in range(10):
        motion.add(move(k, k + 1), 0.0)
    assert run_dry(motion) == pytest.approx(10 / 10 + 10 / 200, rel=1e-6)


def test_a_reversal_stops_in_between() -> None:
    motion = Motion()
    motion.add(move(0, 5), 0.0)
    motion.add(move(5, 0), 0.0)
    assert run_dry(motion) == pytest.approx(2 * (5 / 10 + 10 / 200), rel=1e-6)


def test_a_hold_stops_within_its_braking_distance_and_resumes_to_the_exact_end() -> None:
    motion = Motion()
    motion.add(move(0, 20), 0.0)
    motion.hold(1.0)
    before = motion.position(1.0)[0]
    stop = motion.next_event()
    assert stop is not None
    assert stop == pytest.approx(1.0 + 10 / 200)
    motion.finish_due(stop)
    assert motion.stopped_in_hold(stop)
    assert motion.position(50.0)[0] - before == pytest.approx(10**2 / 400 * PER_MM, abs=1)
    motion.resume(60.0)
    run_dry(motion)
    assert motion.position(99.0)[0] == 20 * PER_MM


def test_a_hold_may_brake_across_queued_moves() -> None:
    motion = Motion()
    for k in range(200):
        motion.add(move(k / 100, (k + 1) / 100), 0.0)
    while (due := motion.next_event()) is not None and due <= 0.1:
        motion.finish_due(due)
    motion.hold(0.1)
    while (due := motion.next_event()) is not None:
        motion.finish_due(due)
    stopped = motion.position(1.0)[0] / PER_MM
    assert stopped == pytest.approx((10**2 / 400) + 10 * 0.05 + 10**2 / 400, abs=2 / PER_MM)
    motion.resume(2.0)
    run_dry(motion)
    assert motion.position(99.0)[0] == 2 * PER_MM


def test_it_tells_when_a_place_is_reached() -> None:
    motion = Motion()
    motion.add(move(0, 20), 0.0)
    when = motion.when_reached(0, 10 * PER_MM)
    assert when is not None
    assert motion.position(when)[0] == pytest.approx(10 * PER_MM, abs=1)
    assert motion.when_reached(0, 21 * PER_MM) is None
