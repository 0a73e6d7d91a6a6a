"""The GRBL driver over a real pseudo-terminal: exact steps, exact travel, flow control, link quality."""

from __future__ import annotations

import os
import select
import socket
import threading
from collections.abc import Callable

import pytest

from scanning.errors import StageFault
from scanning.rig.grbl import GrblStage
from scanning.rig.simulated.bench import Bench

STEP_UM = 0.49


def truth_steps(bench: Bench) -> int:
    return round(float(bench.state()["position_um"]) / STEP_UM)


def test_after_homing_the_host_counts_from_zero(stage: GrblStage, bench: Bench) -> None:
    assert stage.position_steps == 0
    assert truth_steps(bench) == 0


def test_every_scan_step_is_seventeen_motor_steps(stage: GrblStage, bench: Bench) -> None:
    for step in range(1, 301):
        stage.move_to(17 * step)
        assert truth_steps(bench) == 17 * step
    assert stage.link_quality().bad_lines == stage.link_quality().retries == 0


def test_any_single_motor_step_can_be_reached_from_anywhere(stage: GrblStage, bench: Bench) -> None:
    for steps in (204_081, 204_080, 1, 2, 3, 100_003, 99_999, 203_999, 0):
        stage.move_to(steps)
        assert truth_steps(bench) == steps


def test_twelve_thousand_moves_over_100_mm_do_not_drift_and_never_overflow_the_buffer(
    make_bench: Callable[..., Bench],
) -> None:
    """The lines are the driver's (G90, four decimals); streamed, so that the planner is kept full and time is short."""
    bench = make_bench(speed_up=5000.0)
    stage = GrblStage(bench.port, travel_mm=100.0)
    stage.open()
    stage.home()
    seen: list[int] = []
    every = 1000
    for start in range(1, 12_001, every):
        stage.link.stream(
            [f"G1X{k * 17 * STEP_UM / 1000:.4f}F720" for k in range(start, start + every)], timeout_s=10.0
        )
        stage.link.command("G4P0", timeout_s=10.0)
        seen.append(truth_steps(bench) - 17 * (start + every - 1))
    assert seen == [0] * 12
    assert bench.controller.rx_overflows == 0
    assert 100 < stage.link.max_outstanding_bytes <= 127
    assert bench.controller.max_rx_used <= 128
    stage.move_to(17)  # the stage's own idea of where it is survives, absolute as it is
    assert truth_steps(bench) == 17
    stage.close()


@pytest.mark.parametrize("steps", [-1, 204_082, 10**9])
def test_it_refuses_places_outside_the_travel_before_moving(stage: GrblStage, bench: Bench, steps: int) -> None:
    sent = stage.link_quality().lines_sent
    with pytest.raises(StageFault, match="outside the stage's travel of 0 to 100 mm"):
        stage.move_to(steps)
    assert stage.link_quality().lines_sent == sent
    assert stage.position_steps == 0


def test_parking_twice_is_no_fault(stage: GrblStage, bench: Bench) -> None:
    stage.move_to(5000)
    stage.park()
    stage.park()
    assert truth_steps(bench) == 0


def test_a_stage_that_homes_to_the_other_end_counts_away_from_it(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench(settings={23: 0.0})
    stage = GrblStage(bench.port, travel_mm=100.0)
    stage.open()
    stage.home()
    stage.move_to(17 * 100)
    assert truth_steps(bench) == 17 * 100
    stage.close()


def test_without_a_home_switch_zero_is_where_the_carriage_stands(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench(settings={20: 0.0, 21: 0.0, 22: 0.0})
    started = truth_steps(bench)
    stage = GrblStage(bench.port, travel_mm=50.0, zero="here")
    stage.open()
    with pytest.raises(StageFault, match="does not know where it is; home it first"):
        stage.move_to(17)
    stage.home()
    stage.move_to(1700)
    assert truth_steps(bench) == started + 1700
    stage.reset()
    with pytest.raises(StageFault, match="zero is lost"):
        stage.home()
    stage.close()


def test_a_controller_without_homing_is_told_how_to_go_on(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench(settings={20: 0.0, 21: 0.0, 22: 0.0})
    stage = GrblStage(bench.port, travel_mm=50.0)
    stage.open()
    with pytest.raises(StageFault, match=r"homing switched off \(\$22=0\).*'here'"):
        stage.home()
    stage.close()


def test_missing_settings_are_written_once(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench(settings={100: 250.0, 110: 500.0})
    stage = GrblStage(bench.port, travel_mm=100.0, settings={100: 2040.8163, 110: 720})
    stage.open()
    assert bench.controller.settings[100] == pytest.approx(2040.8163, abs=2e-4)
    stage.home()
    stage.move_to(17)
    assert truth_steps(bench) == 17
    stage.close()


def test_work_position_reports_serve_as_well(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench(settings={10: 0.0})
    stage = GrblStage(bench.port, travel_mm=100.0)
    stage.open()
    stage.home()
    for step in range(1, 40):
        stage.move_to(17 * step)
    assert truth_steps(bench) == 17 * 39
    stage.close()


def test_hold_resume_and_jog(stage: GrblStage, bench: Bench) -> None:
    stage.jog(20_000)
    stage.cancel_jog()
    with pytest.raises(StageFault, match="home it first"):
        _ = stage.position_steps
    stage.home()
    stage.hold()
    assert bench.state()["controller"] in ("Hold", "Idle")
    stage.resume()
    stage.move_to(170)
    assert truth_steps(bench) == 170


def test_it_can_be_opened_again_after_closing(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench()
    stage = GrblStage(bench.port, travel_mm=100.0)
    for _ in range(3):
        stage.open()
        stage.home()
        stage.close()
        stage.close()
    with pytest.raises(StageFault):
        stage.move_to(1)


def test_it_works_over_a_serial_server(bench: Bench) -> None:
    """socket:// as of a serial-to-network adapter: a thread carries bytes between TCP and the bench's port."""
    server = socket.create_server(("127.0.0.1", 0))

    def carry() -> None:
        host, _ = server.accept()
        device = os.open(bench.port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        with host:
            while True:
                ready, _, _ = select.select([host.fileno(), device], [], [], 5.0)
                if device in ready:
                    host.sendall(os.read(device, 4096))
                if host.fileno() in ready:
                    data = host.recv(4096)
                    if not data:
                        break
                    os.write(device, data)
        os.close(device)

    adapter = threading.Thread(target=carry)
    adapter.start()
    stage = GrblStage(f"socket://127.0.0.1:{server.getsockname()[1]}", travel_mm=100.0)
    stage.open()
    stage.home()
    for step in range(1, 30):
        stage.move_to(17 * step)
    assert truth_steps(bench) == 17 * 29
    stage.close()
    adapter.join(5.0)
    server.close()
