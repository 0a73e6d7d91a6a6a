"""Boards with the real firmware; every test here skips where there is none."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from scanning.rig.grbl import GrblLaser, GrblStage
from tests.scanning.rig.real_firmware.board import Board, build, why_not

#: The paper's stage at the fastest the firmware can step.
STAGE = {100: 2040.8163, 110: 882.0, 120: 500.0, 130: 101.0, 1: 255, 30: 1000, 32: 0, 20: 0, 21: 0, 22: 0}
STEP_UM = 0.49


@pytest.fixture(scope="session")
def bench_program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if reason := why_not():
        pytest.skip(reason)
    return build(tmp_path_factory.mktemp("avr"))


@pytest.fixture
def make_board(bench_program: Path, tmp_path: Path) -> Iterator[Callable[..., Board]]:
    boards: list[Board] = []
    number = itertools.count()

    def make(**options: int | None) -> Board:
        folder = tmp_path / str(next(number))
        folder.mkdir()
        boards.append(Board(bench_program, folder, **options))
        return boards[-1]

    yield make
    for board in boards:
        board.stop()


@pytest.fixture
def board(make_board: Callable[..., Board]) -> Board:
    return make_board()


def stage_on(board: Board, *, zero: str = "here", **settings: float) -> GrblStage:
    """An open stage; ``settings`` as s22=1."""
    wanted = STAGE | {int(name[1:]): value for name, value in settings.items()}
    stage = GrblStage(board.port, travel_mm=100.0, zero=zero, settings=wanted)
    stage.open()
    return stage


@pytest.fixture
def stage(board: Board) -> Iterator[GrblStage]:
    """A stage without home switches whose zero is where it stands."""
    stage = stage_on(board)
    stage.home()
    yield stage
    stage.close()


@pytest.fixture
def laser(stage: GrblStage) -> GrblLaser:
    return GrblLaser(stage)
