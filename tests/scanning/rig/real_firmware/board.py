"""A board with the real GRBL 1.1 firmware for tests: an ATmega328P in simavr, its carriage and its laser watched.

Our simulated controller was written by the people who wrote the driver; both could share a mistake. The firmware that
runs on thousands of machines cannot share it. It is GPL and not part of this repository: the tests that use this skip
unless ``EDGEWATCH_GRBL_HEX`` names a hex file of GRBL 1.1 for the ATmega328P and simavr's headers are installed
(docs/hardware.md says how).
"""

from __future__ import annotations

import mmap
import os
import shutil
import struct
import subprocess
import time
from collections.abc import Callable
from enum import IntEnum
from pathlib import Path

CPU_HZ = 16_000_000
#: Further than any carriage goes: no switch there.
NOWHERE = 10**12


class Word(IntEnum):
    """Places in the shared file, as in avr_bench.c."""

    CYCLES = 0
    X_STEPS = 1
    Y_STEPS = 2
    Z_STEPS = 3
    LASER_DUTY = 4
    RESTARTS = 5
    PORT_OPEN = 6
    X_PULSES = 7
    BYTES_LOST = 8
    AS_FAST_AS_POSSIBLE = 16
    RESTART_WANTED = 17
    RESTART_ON_OPEN_MS = 18
    SWITCH_ABOVE = 19
    SWITCH_BELOW = 20
    HOLD_BUTTON = 21


def why_not() -> str | None:
    """The reason why no board can be started here, or None."""
    firmware = os.environ.get("EDGEWATCH_GRBL_HEX", "")
    if not firmware:
        return "EDGEWATCH_GRBL_HEX does not name a GRBL 1.1 hex file"
    if not Path(firmware).is_file():
        return f"EDGEWATCH_GRBL_HEX names {firmware}, which does not exist"
    if shutil.which("cc") is None or not Path("/usr/include/simavr/sim_avr.h").exists():
        return "needs a C compiler and libsimavr-dev"
    return None


def build(folder: Path) -> Path:
    """Compile the bench program into ``folder``."""
    program = folder / "avr_bench"
    source = Path(__file__).with_name("avr_bench.c")
    subprocess.run(
        ["cc", "-O2", "-o", str(program), str(source), "-I/usr/include/simavr", "-lsimavr"], check=True, timeout=60
    )
    return program


class Board:
    """One running board. ``restarts_on_open_ms``: how long its bootloader takes after the port opens; None: never."""

    def __init__(self, program: Path, folder: Path, *, restarts_on_open_ms: int | None = None) -> None:
        state = folder / "state"
        state.write_bytes(b"\0" * 256)
        descriptor = os.open(state, os.O_RDWR)
        self._words = mmap.mmap(descriptor, 256)
        os.close(descriptor)
        self[Word.RESTART_ON_OPEN_MS] = -1 if restarts_on_open_ms is None else restarts_on_open_ms
        self[Word.SWITCH_ABOVE], self[Word.SWITCH_BELOW] = NOWHERE, -NOWHERE
        self._process = subprocess.Popen(
            [str(program), os.environ["EDGEWATCH_GRBL_HEX"], str(state)], stdout=subprocess.PIPE, text=True
        )
        assert self._process.stdout is not None
        self.port = self._process.stdout.readline().strip()
        assert self.port, "the bench program did not start"

    def __getitem__(self, word: Word) -> int:
        value: int = struct.unpack_from("q", self._words, 8 * word)[0]
        return value

    def __setitem__(self, word: Word, value: int) -> None:
        struct.pack_into("q", self._words, 8 * word, value)

    def seconds(self) -> float:
        """The board's own time; slower than the wall clock on a busy machine."""
        return self[Word.CYCLES] / CPU_HZ

    def wait_for(self, condition: Callable[[], bool], *, within_s: float) -> bool:
        """Whether ``condition`` comes true within so many seconds of the board's time."""
        end = self.seconds() + within_s
        while self.seconds() < end:
            if condition():
                return True
            time.sleep(0.001)
        return condition()

    def stop(self) -> None:
        self._process.kill()
        self._process.wait()
        if self._process.stdout is not None:
            self._process.stdout.close()
        self._words.close()
