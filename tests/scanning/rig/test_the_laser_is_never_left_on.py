"""Laser on and off through the controller's spindle output, in every state the controller can be in."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from scanning.errors import StageFault
from scanning.rig.grbl import GrblLaser, GrblStage
from scanning.rig.simulated.bench import Bench
from tests.scanning.rig.conftest import laser_of, wait_until

ROOT = Path(__file__).resolve().parents[3]


@pytest.mark.parametrize("laser_mode", [0.0, 1.0])
def test_it_shines_constantly_at_standstill_and_in_motion_whatever_the_laser_mode(
    make_bench: Callable[..., Bench], laser_mode: float
) -> None:
    bench = make_bench(settings={32: laser_mode})
    stage = GrblStage(bench.port, travel_mm=100.0)
    stage.open()
    stage.home()
    laser = GrblLaser(stage, power=0.5)
    assert laser_of(bench) == 0.0
    laser.on()
    assert laser_of(bench) == 0.5
    for step in range(1, 5):
        stage.move_to(17 * step)
        assert laser_of(bench) == 0.5
    laser.off()
    assert laser_of(bench) == 0.0
    stage.close()


def test_closing_the_stage_darkens_the_laser(stage: GrblStage, laser: GrblLaser, bench: Bench) -> None:
    laser.on()
    stage.close()
    assert laser_of(bench) == 0.0
    laser.off()  # and off works on a closed stage too


def test_off_works_while_the_stage_is_on_hold(stage: GrblStage, laser: GrblLaser, bench: Bench) -> None:
    laser.on()
    stage.hold()
    assert laser_of(bench) == 1.0  # with $32=0 a hold alone does not darken it
    laser.off()
    assert laser_of(bench) == 0.0


def test_off_works_after_an_alarm_and_after_an_emergency_stop(stage: GrblStage, laser: GrblLaser, bench: Bench) -> None:
    laser.on()
    bench.provoke("stage", "alarm")
    laser.off()
    assert laser_of(bench) == 0.0
    stage.home()
    laser.on()
    stage.emergency_stop()
    laser.off()
    assert laser_of(bench) == 0.0


def test_off_says_so_when_it_cannot_be_confirmed(stage: GrblStage, laser: GrblLaser, bench: Bench) -> None:
    laser.on()
    bench.wire.unplug()
    with pytest.raises(StageFault, match=r"could not be confirmed off .* by its key"):
        laser.off()


def test_emergency_stop_from_another_thread_ends_a_long_move_within_100_ms(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench(speed_up=20.0)
    stage = GrblStage(bench.port, travel_mm=100.0)
    stage.open()
    stage.home()
    laser = GrblLaser(stage)
    laser.on()
    ended: list[BaseException] = []

    def long_move() -> None:
        try:
            stage.move_to(200_000)
        except StageFault as fault:
            ended.append(fault)

    mover = threading.Thread(target=long_move)
    mover.start()
    assert wait_until(lambda: bool(bench.state()["moving"]))
    pressed = time.monotonic()
    stage.emergency_stop()
    assert wait_until(lambda: laser_of(bench) == 0.0 and not bench.state()["moving"], within_s=0.1)
    assert time.monotonic() - pressed < 0.1
    mover.join(2.0)
    assert "Emergency stop" in str(ended[0])
    with pytest.raises(StageFault, match=r"Emergency stop|home it first"):
        stage.move_to(17)
    stage.home()  # a person says it is safe again
    stage.move_to(17)
    stage.close()


def test_a_host_that_is_killed_leaves_the_laser_dark_and_the_stage_on_hold(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench(speed_up=10.0)
    script = (
        "import sys; from scanning.rig.grbl import GrblStage, GrblLaser\n"
        "stage = GrblStage(sys.argv[1], travel_mm=100.0); stage.open(); stage.home(); GrblLaser(stage).on()\n"
        "print('lit', flush=True); stage.move_to(200_000)\n"
    )
    host = subprocess.Popen(
        [sys.executable, "-c", script, bench.port], cwd=ROOT, stdout=subprocess.PIPE, text=True, env=os.environ.copy()
    )
    try:
        assert host.stdout is not None
        assert host.stdout.readline() == "lit\n"
        assert wait_until(lambda: bool(bench.state()["moving"]))
        assert laser_of(bench) == 1.0
    finally:
        host.send_signal(signal.SIGKILL)
        host.wait()
    assert wait_until(lambda: laser_of(bench) == 0.0, within_s=0.2)
    assert wait_until(lambda: bench.state()["controller"] == "Hold" and not bench.state()["moving"], within_s=0.5)
    assert bench.state()["position_um"] < 100_000
    # The next host finds a rig it can use.
    stage = GrblStage(bench.port, travel_mm=100.0)
    stage.open()
    stage.home()
    assert laser_of(bench) == 0.0
    stage.close()
