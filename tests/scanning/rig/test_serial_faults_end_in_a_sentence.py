"""What a serial line and a controller can do wrong in the middle of a scan. Each ends in a `StageFault` that says what
to do, with the laser dark, or is repaired and counted in the link quality. Afterwards the rig can be used again."""

from __future__ import annotations

import threading
from collections.abc import Callable

import pytest

from scanning.errors import StageFault
from scanning.rig.grbl import GrblLaser, GrblStage
from scanning.rig.simulated.bench import Bench
from tests.scanning.rig.conftest import laser_of

STEP_UM = 0.49


@pytest.fixture
def lit(stage: GrblStage) -> GrblStage:
    """A homed stage with the laser on, some steps into a scan."""
    GrblLaser(stage).on()
    for step in range(1, 6):
        stage.move_to(17 * step)
    return stage


def scan_on(stage: GrblStage, steps: int = 5) -> None:
    for _ in range(steps):
        stage.move_to(stage.position_steps + 17)
    stage.confirm()


@pytest.mark.parametrize(
    ("fault", "options", "sentence"),
    [
        ("unplug", {}, r"connection to the stage .* broke .* check the USB cable"),
        ("reset", {}, r"restarted by itself, so its position is lost; check its supply"),
        ("alarm", {"code": 1}, r"ran onto a limit switch \(ALARM:1\); free the carriage"),
    ],
)
def test_what_happens_in_the_middle_of_a_move(
    lit: GrblStage, bench: Bench, fault: str, options: dict[str, int], sentence: str
) -> None:
    bench.provoke("stage", fault, in_move=True, **options)
    with pytest.raises(StageFault, match=sentence):
        scan_on(lit)
    assert laser_of(bench) == 0.0
    with pytest.raises(StageFault, match="home it first"):
        _ = lit.position_steps
    if fault == "unplug":
        bench.wire.replug()
        lit.close()
        lit.open()
    lit.home()
    scan_on(lit)
    assert round(bench.state()["position_um"] / STEP_UM) == 17 * 5


def test_a_cable_pulled_between_moves(lit: GrblStage, bench: Bench) -> None:
    bench.wire.unplug()
    with pytest.raises(StageFault, match="check the USB cable"):
        scan_on(lit)
    assert laser_of(bench) == 0.0
    with pytest.raises(StageFault, match="There is no serial port"):
        GrblStage(bench.port).open()
    lit.close()


def test_a_controller_that_hangs(lit: GrblStage, bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.provoke("stage", "mute")
    clock = _FastClock()
    monkeypatch.setattr(lit.link, "_clock", clock)
    monkeypatch.setattr(lit, "_clock", clock)
    with pytest.raises(StageFault, match="does not answer status requests; check its cable and supply"):
        scan_on(lit)
    with pytest.raises(StageFault, match="could not be confirmed off"):
        GrblLaser(lit).off()
    lit.close()
    # The interlock on DTR darkens the laser although the controller hangs.
    assert wait_dark(bench)


@pytest.mark.parametrize("lost", [1, 2, 5])
def test_bytes_lost_on_the_way_to_the_host_are_repaired_and_counted(lit: GrblStage, bench: Bench, lost: int) -> None:
    lit.confirm()
    bench.provoke("stage", "drop_to_host", count=lost)
    scan_on(lit)
    assert round(bench.state()["position_um"] / STEP_UM) == lit.position_steps == 17 * 10
    quality = lit.link_quality()
    assert quality.bad_lines + quality.retries > 0


@pytest.mark.parametrize("lost", [1, 2, 5, 12])
def test_bytes_lost_on_the_way_to_the_controller_never_leave_the_stage_elsewhere(
    lit: GrblStage, bench: Bench, lost: int
) -> None:
    lit.confirm()
    bench.provoke("stage", "drop_to_controller", count=lost)
    sentence = ""
    try:
        scan_on(lit)
    except StageFault as fault:
        sentence = str(fault)
    if sentence:
        assert sentence.endswith("home the stage.")
    else:
        assert round(bench.state()["position_um"] / STEP_UM) == lit.position_steps == 17 * 10


@pytest.mark.parametrize(
    "noise", ["\xff\xfe\x80", "ok\xff\r\n", "<Idle|MPos:\r\n", "error:\r\n", "<Idle|MPos:x,y,z>\r\n"]
)
def test_garbage_and_half_lines_are_counted_not_believed(lit: GrblStage, bench: Bench, noise: str) -> None:
    lit.confirm()
    bench.provoke("stage", "garbage", text=noise)
    scan_on(lit)
    assert round(bench.state()["position_um"] / STEP_UM) == lit.position_steps == 17 * 10
    assert lit.link_quality().bad_lines > 0


def test_a_line_that_lands_elsewhere_is_noticed(lit: GrblStage, bench: Bench) -> None:
    """A digit changed on its way is a valid command for GRBL; only the position report gives it away."""
    lit.confirm()
    lit.link.command("G1X0.5000")
    lit._expected_machine_mm = lit._zero_machine_mm + 5 * 0.00833
    with pytest.raises(StageFault, match=r"stands at .* mm instead of .*; check the serial line"):
        lit.confirm()


def test_a_report_without_a_position_vouches_for_nothing(
    lit: GrblStage, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Found with the real firmware on a bad cable: one lost letter of MPos, and 0.35 mm went unnoticed."""
    lit.confirm()
    say = bench.controller._say
    spoiled: list[str] = []

    def spoil(text: str) -> None:
        if text.startswith("<Idle") and not spoiled:
            spoiled.append(text)
            text = text.replace("MPos", "Mos")
        say(text)

    monkeypatch.setattr(bench.controller, "_say", spoil)
    lit.link.command("G1X0.5000")  # stands for a move whose digits were changed on their way
    lit._expected_machine_mm = lit._zero_machine_mm + 5 * 0.00833
    lit.link.ask_status()
    with pytest.raises(StageFault, match=r"stands at .* mm instead of .*; check the serial line"):
        lit.confirm()
    assert spoiled


def test_a_board_that_greets_once_more_while_it_is_being_opened(
    make_bench: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A slow board greets for itself and again for the reset that was sent meanwhile; neither is a restart."""
    bench = make_bench(speed_up=1.0)
    bench.clock.speed_up = 40.0
    controller = bench.controller
    greet = controller._greet

    def late() -> None:
        greet()
        controller.line._out_free += 5.0  # machine time: an eighth of a second
        greet()

    monkeypatch.setattr(controller, "_greet", late)
    stage = GrblStage(bench.port, travel_mm=100.0)
    stage.open()
    assert stage.link.quality.resets == 0
    monkeypatch.setattr(controller, "_greet", greet)
    stage.home()
    stage.close()


def test_a_controller_that_stalls_for_a_while_and_goes_on(lit: GrblStage, bench: Bench) -> None:
    lit.confirm()
    bench.provoke("stage", "mute")
    awake = threading.Timer(0.3, lambda: bench.provoke("stage", "unmute"))
    awake.start()
    scan_on(lit)
    awake.join()
    assert round(bench.state()["position_um"] / STEP_UM) == lit.position_steps == 17 * 10
    assert lit.link_quality().retries > 0
    assert laser_of(bench) == 1.0


def test_somebody_presses_hold_at_the_machine(lit: GrblStage, bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    with bench.wire.lock:
        bench.controller.faults.in_move = bench.controller._feed_hold
    clock = _FastClock()
    monkeypatch.setattr(lit.link, "_clock", clock)
    with pytest.raises(StageFault, match=r"put on hold from outside .*release it"):
        scan_on(lit)


def test_a_broken_home_switch_is_named_and_homing_works_once_it_is_mended(lit: GrblStage, bench: Bench) -> None:
    bench.provoke("stage", "dead_switch")
    with pytest.raises(StageFault, match=r"home switch was not found \(ALARM:9\); check the switch, its cable"):
        lit.home()
    assert laser_of(bench) == 0.0
    bench.controller.faults.dead_switch = False
    lit.home()
    scan_on(lit)


def test_unknown_status_fields_and_a_grblhal_banner_are_taken(
    make_bench: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = make_bench()
    say = bench.controller._say

    def dialect(text: str) -> None:
        if text.startswith("<"):
            text = text[:-1] + "|A:|TLR:0|SD:3.5,job.nc|H:1,7>"
        say(text.replace("Grbl 1.1h", "GrblHAL 1.1f"))

    monkeypatch.setattr(bench.controller, "_say", dialect)
    stage = GrblStage(bench.port, travel_mm=100.0)
    stage.open()
    assert stage.link.banner.startswith("GrblHAL 1.1f")
    stage.home()
    stage.move_to(170)
    stage.confirm()
    assert round(bench.state()["position_um"] / STEP_UM) == 170
    stage.close()


def test_a_controller_that_never_greets_is_found_by_its_status(
    make_bench: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = make_bench()
    say = bench.controller._say
    monkeypatch.setattr(bench.controller, "_say", lambda text: None if text.startswith("Grbl") else say(text))
    stage = GrblStage(bench.port, travel_mm=100.0, clock=_FastClock())
    stage.open()
    stage.home()
    stage.close()


def wait_dark(bench: Bench) -> bool:
    from tests.scanning.rig.conftest import wait_until

    return wait_until(lambda: laser_of(bench) == 0.0, within_s=0.2)


class _FastClock:
    """Time that runs 20 times as fast as the wall's, so that timeouts of seconds are tested in fractions."""

    def __init__(self) -> None:
        import time

        self._now, self._start = time.monotonic, time.monotonic()

    def __call__(self) -> float:
        return self._start + (self._now() - self._start) * 20
