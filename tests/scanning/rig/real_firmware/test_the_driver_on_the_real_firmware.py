"""All that the driver relies on, against GRBL 1.1h itself: carriage and laser output are watched from outside.

Times are the board's own; on a busy machine it runs slower than the wall clock.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

import pytest

from scanning.errors import StageFault
from scanning.rig.grbl import GrblLaser, GrblStage
from tests.scanning.rig.real_firmware.board import NOWHERE, Board, Word
from tests.scanning.rig.real_firmware.conftest import stage_on

FAR = 100_000
"""49 mm in motor steps, some seconds away."""


def in_background(act: Callable[[], None]) -> tuple[threading.Thread, list[BaseException]]:
    """Run a move beside the test; what it raises is kept."""
    faults: list[BaseException] = []

    def run() -> None:
        try:
            act()
        except BaseException as fault:
            faults.append(fault)

    thread = threading.Thread(target=run)
    thread.start()
    return thread, faults


def test_a_board_that_restarts_when_its_port_opens(make_board: Callable[..., Board]) -> None:
    board = make_board(restarts_on_open_ms=1600)  # an Arduino's bootloader swallows what comes earlier
    stage = stage_on(board)
    assert board[Word.RESTARTS] == 1
    assert stage.link.banner.startswith("Grbl 1.1")
    assert stage.controller_settings[100] == pytest.approx(2040.816, abs=1e-3)
    assert stage.link.quality.bad_lines == stage.link.quality.retries == stage.link.quality.resets == 0
    stage.close()


def test_settings_survive_in_the_board_and_are_not_written_again(board: Board) -> None:
    stage_on(board).close()
    again = GrblStage(board.port, travel_mm=100.0, zero="here")
    again.open()
    assert again.controller_settings[110] == 882.0
    assert again.controller_settings[1] == 255.0
    again.close()


def test_steps_of_8_33_um_never_lose_or_gain_a_motor_step(board: Board, stage: GrblStage) -> None:
    for k in range(1, 101):
        stage.move_to(17 * k)
        assert board[Word.X_STEPS] == 17 * k  # standing still when move_to returns, to the step
    stage.confirm()
    assert stage.link.quality.retries == stage.link.quality.bad_lines == 0


def test_the_whole_travel_in_one_move_at_the_highest_step_rate(board: Board, stage: GrblStage) -> None:
    stage.move_to(204_000)
    assert board[Word.X_STEPS] == 204_000
    for k in range(1, 21):  # where 32-bit floats are coarsest
        stage.move_to(204_000 - 17 * k)
        assert board[Word.X_STEPS] == 204_000 - 17 * k


@pytest.mark.parametrize("laser_mode", [0, 1])
def test_the_laser_is_lit_at_standstill_and_on_the_way(make_board: Callable[..., Board], laser_mode: int) -> None:
    board = make_board()
    stage = stage_on(board, s32=laser_mode)
    stage.home()
    laser = GrblLaser(stage, power=0.5)
    stage.move_to(340)
    assert board[Word.LASER_DUTY] == 0
    laser.on()
    assert board.wait_for(lambda: board[Word.LASER_DUTY] in (127, 128), within_s=0.1)
    for k in range(1, 6):
        stage.move_to(340 + 17 * k)
        assert board[Word.LASER_DUTY] in (127, 128)
    laser.off()
    assert board.wait_for(lambda: board[Word.LASER_DUTY] == 0, within_s=0.1)
    assert stage.position_steps == 340 + 17 * 5  # switching off costs nothing but light
    stage.close()


def test_hold_and_resume_in_a_long_move_lose_nothing(board: Board, stage: GrblStage) -> None:
    move, faults = in_background(lambda: stage.move_to(FAR))
    assert board.wait_for(lambda: board[Word.X_STEPS] > 5_000, within_s=5)
    stage.hold()
    assert board.wait_for(lambda: _rests(board), within_s=2)
    assert board[Word.X_STEPS] < FAR
    stage.resume()
    move.join(30)
    assert not move.is_alive()
    assert not faults
    assert board[Word.X_STEPS] == FAR
    assert stage.position_steps == FAR


def test_emergency_stop_in_a_move(board: Board, stage: GrblStage, laser: GrblLaser) -> None:
    laser.on()
    move, faults = in_background(lambda: stage.move_to(FAR))
    assert board.wait_for(lambda: board[Word.X_STEPS] > 5_000, within_s=5)
    asked = board.seconds()
    stage.emergency_stop()
    assert board.wait_for(lambda: board[Word.LASER_DUTY] == 0, within_s=0.1)
    assert board.seconds() - asked < 0.1
    assert _rests(board)
    move.join(10)
    assert "Emergency stop" in str(faults[0])
    with pytest.raises(StageFault, match="Emergency stop"):
        stage.move_to(0)


def test_a_board_that_restarts_in_a_move(board: Board, stage: GrblStage, laser: GrblLaser) -> None:
    laser.on()
    move, faults = in_background(lambda: stage.move_to(FAR))
    assert board.wait_for(lambda: board[Word.X_STEPS] > 5_000, within_s=5)
    board[Word.RESTART_WANTED] = 1
    move.join(10)
    assert "restarted by itself, so its position is lost" in str(faults[0])
    assert board[Word.LASER_DUTY] == 0
    with pytest.raises(StageFault, match="home it first"):
        _ = stage.position_steps
    with pytest.raises(StageFault, match="its zero is lost; put the carriage at its zero and open the rig again"):
        stage.home()


def test_jog_and_jog_cancel(board: Board, stage: GrblStage) -> None:
    stage.jog(FAR)
    assert board.wait_for(lambda: board[Word.X_STEPS] > 2_000, within_s=5)
    stage.cancel_jog()
    assert board.wait_for(lambda: _rests(board), within_s=2)
    assert board[Word.X_STEPS] < FAR
    assert stage.link.status().state == "Idle"


def test_homing_finds_the_switch_and_soft_limits_hold(board: Board) -> None:
    board[Word.SWITCH_ABOVE] = 4_000  # the switches of all three axes: the stock firmware homes them together
    stage = stage_on(
        board, zero="homing", s20=1, s21=1, s22=1, s24=60, s25=600, s27=1, s101=500, s102=500, s111=3000, s112=3000,
        s121=500, s122=500, s131=101, s132=101,
    )  # fmt: skip
    stage.home()
    home = board[Word.X_STEPS]
    assert home == pytest.approx(4_000 - 2041, abs=30)
    stage.move_to(1_700)
    assert board[Word.X_STEPS] == home - 1_700  # homing upwards: the scan runs downwards
    with pytest.raises(StageFault, match="outside the stage's travel"):
        stage.move_to(round(100.5 / 0.00049))
    with pytest.raises(StageFault, match=r"would have left the stage's travel \(ALARM:2\)"):
        stage.link.command("G53 G1 X-150 F600", timeout_s=5)
    stage.home()
    assert board[Word.X_STEPS] == pytest.approx(home, abs=30)
    assert stage.link.status().state == "Idle"
    stage.close()


def test_a_limit_switch_in_the_middle_of_a_move(make_board: Callable[..., Board]) -> None:
    board = make_board()
    stage = stage_on(board, s21=1)
    stage.home()
    GrblLaser(stage).on()
    board[Word.SWITCH_ABOVE] = 8_000
    with pytest.raises(StageFault, match=r"ran onto a limit switch \(ALARM:1\); free the carriage"):
        stage.move_to(FAR)
    assert board[Word.LASER_DUTY] == 0
    board[Word.SWITCH_ABOVE] = NOWHERE
    stage.reset()
    stage.unlock()
    stage.jog(-2_000)
    assert board.wait_for(lambda: _rests(board), within_s=5)
    stage.close()


def test_a_hold_button_is_told(board: Board, stage: GrblStage) -> None:
    move, faults = in_background(lambda: stage.move_to(FAR))
    assert board.wait_for(lambda: board[Word.X_STEPS] > 5_000, within_s=5)
    board[Word.HOLD_BUTTON] = 1
    move.join(60)
    assert "put on hold from outside" in str(faults[0])


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("$H", r"homing is switched off in the controller \(error:5\)"),
        ("$20=1", r"soft limits need homing \(error:10\)"),
        ("G1 X1", r"no feed rate has been set \(error:22\)"),
        ("G999", r"does not know this G-code \(error:20\)"),
        ("$J=X1", r"no feed rate has been set \(error:22\)"),
        ("G1 X" + "1" * 90 + " F100", r"\(error:11\)"),
    ],
)
def test_a_refusal_becomes_a_sentence(stage: GrblStage, line: str, sentence: str) -> None:
    with pytest.raises(StageFault, match=sentence):
        stage.link.command(line)
    assert stage.link.status().state == "Idle"


def test_closing_resets_the_board(board: Board, stage: GrblStage, laser: GrblLaser) -> None:
    laser.on()
    assert board.wait_for(lambda: board[Word.LASER_DUTY] > 0, within_s=0.1)
    stage.close()
    assert board.wait_for(lambda: board[Word.LASER_DUTY] == 0, within_s=0.2)


def _rests(board: Board) -> bool:
    """Whether the carriage stands still for 50 ms of the board's time."""
    before = board[Word.X_STEPS]
    board.wait_for(lambda: False, within_s=0.05)
    return board[Word.X_STEPS] == before
