"""Nothing a host can send makes the emulated controller raise: its wire would die and every wait with it."""

from __future__ import annotations

import random

import pytest

from scanning.rig.simulated.controller import RX_BYTES, Controller

PIECES = [
    "G0", "G1", "G4", "G10", "G17", "G20", "G21", "G53", "G54", "G80", "G90", "G91", "G92", "G92.1", "G93", "M3", "M4",
    "M5", "S500", "S0", "F100", "F0", "X1", "X-0.5", "X1e9", "Y2", "Z-99999999", "P0.01", "P1", "L2", "L20", "N1", "T1",
    "X", "G", "$$", "$H", "$X", "$G", "$#", "$I", "$N", "$C", "$", "$20=0", "$21=0", "$22=0", "$22=1", "$100=0",
    "$100=2040", "$27=0", "$24=0", "$120=0", "$110=600", "$30=0", "$32=1", "$10=0", "$10=3", "$=", "$1=", "$5=x",
    "$J=G91X1F100", "$J=X1", "(", ")", ";", "%", " ", "\t", ".", "-", "+.", "1",
]  # fmt: skip
REAL_TIME = [0x18, 0x85, 0x84, 0x90, 0x9E, 0xFF, ord("?"), ord("!"), ord("~")]


@pytest.mark.parametrize("seed", range(12))
def test_random_conversations(seed: int) -> None:
    rng = random.Random(seed)
    controller = Controller()
    now = 0.0
    controller.link_found()
    for _ in range(1500):
        kind = rng.random()
        if kind < 0.75:
            controller.receive(("".join(rng.choices(PIECES, k=rng.randint(1, 5))) + "\n").encode())
        elif kind < 0.92:
            controller.receive(bytes([rng.choice(REAL_TIME)]))
        elif kind < 0.97:
            controller.receive(rng.randbytes(rng.randint(1, 40)))
        elif kind < 0.98:
            controller.link_lost()
            controller.link_found()
        elif kind < 0.99:
            controller.trip_alarm()
        else:
            controller.unplug()
            controller.replug()
        now += rng.choice((0.0, 1e-4, 0.01, 1.0, 30.0))
        controller.advance(now)
        controller.transmit()
        due = controller.next_event()
        assert due is None or due >= now - 1e-9 or controller.transmit() == b""
        assert 0.0 <= controller.laser_power(now) <= 1.0
        assert len(controller._rx) <= RX_BYTES
    controller.link_lost()
    assert controller.laser_power(now) == 0.0
