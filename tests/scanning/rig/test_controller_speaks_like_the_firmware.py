"""The emulated controller against the transcript of the real GRBL 1.1h firmware (built for a PC, driven over a pty).

Expected answers are copied from that transcript; virtual time, no thread, no port.
"""

from __future__ import annotations

import re

import pytest

from scanning.rig.simulated.controller import Controller

#: The PC build has no limit switches, homing off, 1.1h defaults.
BARE = {20: 0.0, 21: 0.0, 22: 0.0, 100: 2040.8163, 110: 500.0, 120: 10.0, 130: 200.0}


class Conversation:
    def __init__(self, settings: dict[int, float] | None = None, *, start_um: float = 7000.0) -> None:
        self.controller = Controller(settings=settings, start_um=start_um)
        self.controller.hard_reset()
        self.now = 0.0
        self.wait(2.0)

    def wait(self, seconds: float) -> list[str]:
        self.now += seconds
        self.controller.advance(self.now)
        return [line for line in self.controller.transmit().decode().split("\r\n") if line]

    def say(self, text: str | bytes, *, wait: float = 0.1) -> list[str]:
        self.controller.receive(text if isinstance(text, bytes) else text.encode() + b"\n")
        return self.wait(wait)


@pytest.fixture
def grbl() -> Conversation:
    return Conversation(BARE)


def test_it_greets_after_a_reset(grbl: Conversation) -> None:
    assert grbl.say(b"\x18") == ["Grbl 1.1h ['$' for help]"]


def test_it_tells_version_and_buffer_sizes(grbl: Conversation) -> None:
    assert grbl.say("$I") == ["[VER:1.1h.20190830:]", "[OPT:V,15,128]", "ok"]


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        ("$X", ["ok"]),
        ("$H", ["error:5"]),
        ("$20=1", ["error:10"]),
        ("G1 X1", ["error:22"]),
        ("GARBAGE", ["error:2"]),
        ("G999", ["error:20"]),
        ("X" * 90, ["error:11"]),
        ("", ["ok"]),
        ("$100=2040.816326530612", ["ok"]),
        ("G92", ["error:26"]),
        ("G0 G1 X1", ["error:21"]),
        ("G1 X1 X2 F5", ["error:25"]),
        ("$J=X1", ["error:22"]),
        ("$J=M3 X1 F5", ["error:16"]),
        ("(a comment) G21 ; and more", ["ok"]),
        ("$9999=1", ["error:3"]),
    ],
)
def test_it_answers_a_line_as_the_firmware_does(grbl: Conversation, line: str, answer: list[str]) -> None:
    assert grbl.say(line) == answer


def test_it_prints_steps_per_mm_with_three_decimals(grbl: Conversation) -> None:
    grbl.say("$100=2040.816326530612")
    assert "$100=2040.816" in grbl.say("$$", wait=1.0)


def test_one_scan_step_is_seventeen_motor_steps_and_reports_come_with_their_fields(grbl: Conversation) -> None:
    assert grbl.say("G21 G92 X0") == ["ok"]
    assert grbl.say("G91") == ["ok"]
    assert grbl.say("G1 X0.00833 F60") == ["ok"]
    assert grbl.controller.position_steps(grbl.now)[0] == 17
    assert grbl.say(b"?") == ["<Idle|MPos:0.008,0.000,0.000|Bf:15,128|FS:0,0|WCO:0.000,0.000,0.000>"]
    assert grbl.say(b"?") == ["<Idle|MPos:0.008,0.000,0.000|Bf:15,128|FS:0,0|Ov:100,100,100>"]


def test_hold_and_resume_keep_the_move(grbl: Conversation) -> None:
    grbl.say("G90", wait=0.05)
    assert grbl.say("G1 X5 F120", wait=0.5) == ["ok"]
    running = grbl.say(b"?")[0]
    assert running.startswith("<Run|MPos:0.")
    assert "FS:120,0" in running
    grbl.say(b"!", wait=0.5)
    held = grbl.say(b"?")[0]
    assert held.startswith("<Hold:0|")
    assert "|FS:0,0" in held
    grbl.wait(10.0)
    assert re.search(r"MPos:([\d.]+)", held)[1] in grbl.say(b"?")[0]  # type: ignore[index]
    grbl.say(b"~", wait=0.2)
    assert grbl.say(b"?")[0].startswith("<Run|")
    grbl.wait(5.0)
    assert "<Idle|MPos:5.000" in grbl.say(b"?")[0]


def test_a_reset_in_motion_is_alarm_3_and_locks(grbl: Conversation) -> None:
    grbl.say("G1 X5 F120", wait=0.5)
    assert grbl.say(b"\x18") == ["ALARM:3", "Grbl 1.1h ['$' for help]", "[MSG:'$H'|'$X' to unlock]"]
    assert grbl.say(b"?")[0].startswith("<Alarm|MPos:0.")
    assert grbl.say("G1 X0") == ["error:9"]
    assert grbl.say("$X") == ["[MSG:Caution: Unlocked]", "ok"]
    assert grbl.say("G1 X0 F100") == ["ok"]


def test_a_reset_after_the_hold_came_to_rest_keeps_the_position(grbl: Conversation) -> None:
    grbl.say("G1 X5 F120", wait=0.5)
    grbl.say(b"!", wait=1.0)
    assert grbl.say(b"\x18") == ["Grbl 1.1h ['$' for help]"]


def test_settings_and_homing_wait_for_standstill(grbl: Conversation) -> None:
    grbl.say("G1 X5 F120", wait=0.2)
    assert grbl.say("$$") == ["error:8"]
    assert grbl.say("$H") == ["error:8"]


def test_a_jog_is_cancelled_without_alarm(grbl: Conversation) -> None:
    assert grbl.say("$J=G91 X-2 F200", wait=0.2) == ["ok"]
    assert grbl.say(b"?", wait=0.02)[0].startswith("<Jog|")
    grbl.say(b"\x85", wait=1.0)
    assert grbl.say(b"?")[0].startswith("<Idle|MPos:-")


def test_soft_limits_refuse_a_jog_and_lock_up_on_a_move() -> None:
    grbl = Conversation()
    grbl.say("$H", wait=60.0)
    assert grbl.say("$J=G91 X900 F100") == ["error:15"]
    assert grbl.say("G91 G1 X900 F100") == ["ALARM:2"]
    assert grbl.say(b"\x18") == []  # forgotten: the firmware is still busy with its message
    assert grbl.wait(0.5) == ["[MSG:Reset to continue]"]
    assert grbl.say("$X") == []  # deaf to everything but a reset
    assert grbl.say(b"\x18") == ["Grbl 1.1h ['$' for help]", "[MSG:'$H'|'$X' to unlock]"]


def test_homing_finds_the_switch_and_backs_off() -> None:
    grbl = Conversation()
    assert grbl.say(b"?")[0].startswith("<Alarm|")
    assert grbl.say("$H", wait=60.0) == ["ok"]
    assert grbl.say(b"?")[0].startswith("<Idle|MPos:-119.000,")  # -(130) + pull-off $27
    assert grbl.controller.position_um(grbl.now) == 0.0


def test_homing_toward_the_positive_end_mirrors() -> None:
    grbl = Conversation({23: 0.0})
    assert grbl.say("$H", wait=120.0) == ["ok"]
    assert grbl.say(b"?")[0].startswith("<Idle|MPos:-1.000,")
    assert grbl.controller.position_um(grbl.now) == 0.0


def test_homing_without_a_working_switch_is_alarm_9_and_reset_during_it_alarm_6() -> None:
    grbl = Conversation()
    grbl.controller.faults.dead_switch = True
    assert grbl.say("$H", wait=120.0) == ["ALARM:9", "Grbl 1.1h ['$' for help]", "[MSG:'$H'|'$X' to unlock]"]
    grbl = Conversation()
    grbl.say("$H", wait=0.2)
    assert grbl.say(b"?") == []  # no reports while homing
    assert grbl.say(b"\x18")[0] == "ALARM:6"


def test_homing_from_the_switch_itself_works() -> None:
    grbl = Conversation(start_um=-1000.0)
    assert "|Pn:X" in grbl.say(b"?")[0]
    assert grbl.say("$H", wait=60.0) == ["ok"]
    assert grbl.controller.position_um(grbl.now) == 0.0


def test_running_onto_a_limit_switch_is_alarm_1() -> None:
    grbl = Conversation({20: 0.0}, start_um=2000.0)
    grbl.say("$X")
    assert "ALARM:1" in grbl.say("G91 G1 X-10 F300", wait=5.0)


def test_relative_moves_drift_where_the_firmware_drifts_and_absolute_ones_do_not() -> None:
    """Real firmware: the first wrong step of repeated G91 X0.00833 came at move 1784, one step too far.

    Where exactly depends on the float32 position the run began at, which the transcript does not tell: hence a window.
    """
    grbl = Conversation(BARE)
    grbl.say("$100=2040.816326530612")
    grbl.say("G21 G92 X0")
    grbl.say("G91 F500")
    for move in range(1, 2601):
        grbl.say("G1 X0.00833", wait=0.1)
        wrong = grbl.controller.position_steps(grbl.now)[0] - 17 * move
        if wrong:
            break
    assert wrong == 1
    assert 1774 <= move <= 1794


def test_bytes_take_their_time_on_the_wire(grbl: Conversation) -> None:
    """115200 baud carry one byte in 86.8 us; GRBL's status report of 60 bytes takes more than 5 ms."""
    early = "".join(grbl.say(b"?", wait=0.004))
    assert 40 <= len(early) <= 46
    assert (early + "".join(grbl.wait(0.003))).endswith(">")


def test_the_receive_buffer_holds_128_bytes_and_loses_the_rest(grbl: Conversation) -> None:
    grbl.say("G1 X50 F10", wait=0.1)
    for _ in range(20):  # 15 fill the planner, the others wait in the buffer
        grbl.say("G1 X0 F10", wait=0.05)
        grbl.say("G1 X50 F10", wait=0.05)
    assert grbl.controller.max_rx_used == 128
    assert grbl.controller.rx_overflows > 0
