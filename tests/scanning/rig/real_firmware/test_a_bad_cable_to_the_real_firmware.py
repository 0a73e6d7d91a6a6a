"""What the real firmware makes of a damaged line is up to it; the carriage must never stand elsewhere unnoticed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from scanning.errors import StageFault
from scanning.rig.grbl import GrblLaser, GrblStage
from scanning.rig.protocols import Frame, SensorMode
from scanning.rig.rig import Rig
from scanning.rig.session import ScanPlan, acquire
from tests.scanning.rig.real_firmware.board import Board, Word
from tests.scanning.rig.real_firmware.conftest import STAGE
from tests.scanning.rig.real_firmware.noisy_cable import NoisyCable


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_lost_and_spoiled_bytes_are_repaired_or_told_but_never_believed(board: Board, seed: int) -> None:
    cable = NoisyCable(board.port, seed=seed)
    stage = GrblStage(cable.port, travel_mm=100.0, zero="here", settings=STAGE)
    stage.open()
    stage.home()
    GrblLaser(stage).on()
    cable.loss, cable.spoiling = 0.002, 0.001
    told = ""
    at = 0
    for _ in range(60):
        try:
            stage.move_to(at + 17)
            stage.confirm()
        except StageFault as fault:
            told = str(fault)
            break
        at += 17
        # Two micrometres are what the firmware's own report can tell.
        assert abs(board[Word.X_STEPS] - at) <= 5
    cable.loss = cable.spoiling = 0.0
    quality = stage.link.quality
    assert cable.harmed > 0
    assert told == "" or "; " in told  # what is wrong; what to do
    assert told or quality.bad_lines + quality.retries > 0
    GrblLaser(stage).off()
    assert board.wait_for(lambda: board[Word.LASER_DUTY] == 0, within_s=0.2)
    stage.close()
    cable.pull()


def test_a_cable_that_is_pulled_in_a_move(board: Board) -> None:
    cable = NoisyCable(board.port, seed=0)
    stage = GrblStage(cable.port, travel_mm=100.0, zero="here", settings=STAGE)
    stage.open()
    stage.home()
    with pytest.raises(StageFault, match=r"connection to the stage .* broke .* check the USB cable"):
        stage.move_to_while(100_000, cable.pull)
    with pytest.raises(StageFault, match="home it first"):
        _ = stage.position_steps
    stage.close()


class _Picture:
    """A camera of this test: its frames hold where the board's carriage was and whether its laser shone."""

    saturation = 65535

    def __init__(self, board: Board) -> None:
        self.board, self.number = board, 0
        self.unread: list[Frame] = []

    def open(self) -> None: ...
    def close(self) -> None: ...
    def configure(self, mode: SensorMode) -> None:
        self.unread.clear()

    def grab(self, exposure_us: float, *, timeout_s: float) -> Frame:
        self.expose(exposure_us, timeout_s=timeout_s)
        return self.read_out(timeout_s=timeout_s)

    def expose(self, exposure_us: float, *, timeout_s: float) -> None:
        begin = self.board[Word.X_STEPS]
        self.board.wait_for(lambda: False, within_s=exposure_us * 1e-6)
        self.number += 1
        seen = [begin, self.board[Word.X_STEPS], self.board[Word.LASER_DUTY]]
        self.unread.append(Frame(np.array([seen], np.uint16), exposure_us, self.number, self.board.seconds()))

    def read_out(self, *, timeout_s: float) -> Frame:
        return self.unread.pop(0)


class _Run:
    def read(self) -> str:
        return "run"


def test_a_whole_scan_on_the_real_firmware(make_board: Callable[..., Board]) -> None:
    board = make_board(restarts_on_open_ms=500)
    stage = GrblStage(board.port, travel_mm=20.0, zero="here", settings=STAGE)
    rig = Rig(stage, GrblLaser(stage), _Picture(board), "Rig 1")
    stage.open()
    seen: dict[int, list[Frame]] = {}
    plan = ScanPlan(1.0, 60, (500.0, 2000.0), SensorMode(rows=1, columns=3, bits=16))
    done = acquire(rig, plan, on_frames=lambda step, frames: seen.update({step: frames}), control=_Run())  # type: ignore[arg-type]
    begin = round(1000 / 0.49)
    for step in range(60):
        for frame in seen[step]:
            assert frame.image.tolist() == [[begin + 17 * step, begin + 17 * step, 255]]
    assert done.steps_done == 60
    assert (done.link.bad_lines, done.link.retries, done.link.resets) == (0, 0, 0)
    assert board[Word.X_STEPS] == 0  # parked
    assert board[Word.LASER_DUTY] == 0
    stage.close()
