"""Opening a stage that is not there, not ours, not GRBL or not set up: one sentence each, with what to do."""

from __future__ import annotations

import errno
import os
import pty
import tty
from collections.abc import Callable
from pathlib import Path

import pytest
import serial

from scanning.errors import BadInput, StageFault
from scanning.rig.grbl import GrblLaser, GrblStage
from scanning.rig.grbl_messages import ALARMS, ERRORS, alarm_sentence, error_sentence
from scanning.rig.simulated.bench import Bench


def test_a_port_that_is_not_there() -> None:
    with pytest.raises(StageFault, match="no serial port /dev/no-such-stage; check that the stage is plugged in"):
        GrblStage("/dev/no-such-stage").open()


def test_a_port_that_is_no_serial_port(tmp_path: Path) -> None:
    (tmp_path / "stage").write_text("not a port")
    with pytest.raises(StageFault, match="check"):
        GrblStage(str(tmp_path / "stage")).open()


def test_a_port_that_another_program_has(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench()
    first = GrblStage(bench.port)
    first.open()
    with pytest.raises(StageFault, match="in use by another program"):
        GrblStage(bench.port).open()
    first.home()  # and the one who has it is not disturbed
    first.close()


def test_a_port_without_permission(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object, **__: object) -> None:
        raise serial.SerialException(errno.EACCES, "could not open port")

    monkeypatch.setattr(serial, "serial_for_url", refused)  # root, as in containers, is never refused for real
    with pytest.raises(StageFault, match=r"No permission .* 'dialout'"):
        GrblStage("/dev/ttyUSB0").open()


def test_a_serial_server_that_is_not_there() -> None:
    with pytest.raises(StageFault, match=r"socket://127.0.0.1:9"):
        GrblStage("socket://127.0.0.1:9").open()


def test_a_port_on_which_nobody_answers() -> None:
    master, slave = pty.openpty()
    tty.setraw(slave)
    ticks = iter(range(10_000))
    stage = GrblStage(os.ttyname(slave), clock=lambda: next(ticks) * 0.2)
    with pytest.raises(StageFault, match="no GRBL controller answers; check that it is the stage's port"):
        stage.open()
    assert not stage.link.is_open
    os.close(master)
    os.close(slave)


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({110: 1000.0}, r"34014 steps a second .* lower \$110 to 882 mm/min"),
        ({100: 250.0}, r"set to 250 steps per mm .* needs 2040.8163"),
        ({130: 60.0}, r"travel is 100 mm but the controller .* allows 59 mm"),
    ],
)
def test_a_controller_that_is_set_up_wrongly(
    make_bench: Callable[..., Bench], settings: dict[int, float], sentence: str
) -> None:
    bench = make_bench(settings=settings)
    stage = GrblStage(bench.port, travel_mm=100.0)
    with pytest.raises(StageFault, match=sentence):
        stage.open()
    assert not stage.link.is_open


@pytest.mark.parametrize(
    ("wanted", "sentence"),
    [
        ({110: 1000.0}, r"34014 steps a second .* lower \$110 to 882 mm/min"),
        ({120: 0.0}, r"\$120 = 0; set it above 0"),
        ({110: -5.0}, r"\$110 = -5; set it above 0"),
    ],
)
def test_settings_that_cannot_work_are_never_written(
    make_bench: Callable[..., Bench], wanted: dict[int, float], sentence: str
) -> None:
    bench = make_bench()
    before = dict(bench.controller.settings)
    with pytest.raises(StageFault, match=sentence):
        GrblStage(bench.port, travel_mm=100.0, settings={1: 254, **wanted}).open()
    assert bench.controller.settings == before


@pytest.mark.parametrize("feed", [0.0, 0.5, 721.0, float("nan")])
def test_a_feed_that_the_controller_does_not_make(make_bench: Callable[..., Bench], feed: float) -> None:
    with pytest.raises(StageFault, match=r"moves at 1 to 720 mm/min \(\$110\); correct the rig's feed or \$110"):
        GrblStage(make_bench().port, travel_mm=100.0, feed_mm_min=feed).open()


def test_moving_before_homing(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench()
    stage = GrblStage(bench.port)
    stage.open()
    with pytest.raises(StageFault, match="home it first"):
        stage.move_to(17)
    stage.close()


def test_settings_that_mean_nothing() -> None:
    with pytest.raises(BadInput, match="'homing' or 'here'"):
        GrblStage("x", zero="somewhere")
    with pytest.raises(BadInput, match="positive length"):
        GrblStage("x", step_um=0.0)
    with pytest.raises(BadInput, match="share above 0"):
        GrblLaser(GrblStage("x"), power=0.0)


def test_every_grbl_number_has_a_sentence() -> None:
    """GRBL 1.1 knows errors 1-38 (19 is not used) and alarms 1-9 (doc/csv of the firmware)."""
    assert set(ERRORS) >= set(range(1, 39)) - {19}
    assert set(ALARMS) >= set(range(1, 10))
    assert error_sentence(9) == (
        "the controller is locked after an alarm (error:9); find the cause, then home the stage"
    )
    assert "ALARM:77" in alarm_sentence(77)
    assert "error:77" in error_sentence(77)
