"""What GRBL's numbers mean and what a person does about them.

The controller answers ``error:9`` and ``ALARM:1``. On the shop floor that is worthless; here each number of GRBL 1.1
(doc/csv/error_codes_en_US.csv and alarm_codes_en_US.csv of the firmware, with grblHAL's common additions) becomes a
sentence with the next step. The driver never shows a bare number.
"""

from __future__ import annotations

#: number -> (what is wrong, what to do)
ERRORS: dict[int, tuple[str, str]] = {
    1: ("a command did not begin with a letter", "the serial line may be disturbed: check cable and shielding"),
    2: ("a number was missing or unreadable", "the serial line may be disturbed: check cable and shielding"),
    3: ("the controller does not know this $ command", "check that it runs GRBL 1.1 or newer"),
    4: ("a negative value was sent where none is allowed", "check the rig's configuration"),
    5: ("homing is switched off in the controller", "set $22=1 if the stage has a home switch, or use 'set zero here'"),
    6: ("the step pulse is shorter than 3 us", "set $0 to 3 or more"),
    7: ("the controller's memory could not be read and was reset to defaults", "enter its $ settings again"),
    8: ("the command is only allowed while the stage stands still", "wait until it stands, or reset the controller"),
    9: ("the controller is locked after an alarm", "find the cause, then home the stage"),
    10: ("soft limits need homing", "set $22=1 before $20=1"),
    11: ("the line was longer than the controller can hold", "check the serial line for lost line ends"),
    12: ("the step rate is above what the controller can do", "lower the maximum feed $110"),
    13: ("the safety door is open", "close the door and resume"),
    14: ("the build information or start-up line is too long", "shorten it"),
    15: ("the move would leave the stage's travel", "choose a position inside the travel"),
    16: ("the jog command was malformed", "check that it runs GRBL 1.1 or newer"),
    17: ("laser mode needs a PWM output", "set $32=0 or use firmware built with variable spindle"),
    18: ("the controller is in its restart phase", "wait a moment and try again"),
    20: ("the controller does not know this G-code", "check that it runs GRBL 1.1 or newer"),
    21: ("two commands of one group stood in one line", "the serial line may be disturbed: check cable and shielding"),
    22: ("no feed rate has been set", "set the rig's feed"),
    23: ("a command needs a whole number", "the serial line may be disturbed: check cable and shielding"),
    24: ("two commands in one line want the same axis words", "the serial line may be disturbed: check the cable"),
    25: ("a word was repeated in one line", "the serial line may be disturbed: check cable and shielding"),
    26: ("a command came without its axis", "the serial line may be disturbed: check cable and shielding"),
    27: ("a line number is out of range", "the serial line may be disturbed: check cable and shielding"),
    28: ("a command came without its value", "the serial line may be disturbed: check cable and shielding"),
    29: ("the work coordinate system is not supported", "use G54"),
    30: ("G53 needs G0 or G1", "check that it runs GRBL 1.1 or newer"),
    31: ("axis words came with motion switched off", "reset the controller"),
    32: ("an arc came without axis words", "the serial line may be disturbed: check cable and shielding"),
    33: ("the target of the move is invalid", "check the position that was asked for"),
    34: ("an arc's radius is wrong", "the serial line may be disturbed: check cable and shielding"),
    35: ("an arc came without its centre", "the serial line may be disturbed: check cable and shielding"),
    36: ("a line held words that no command uses", "the serial line may be disturbed: check cable and shielding"),
    37: ("a tool length was set on the wrong axis", "check the controller's configuration"),
    38: ("a tool number is too large", "check the controller's configuration"),
    39: ("a parameter is out of range", "check the rig's configuration"),
    40: ("the command is not allowed while a tool change is pending", "finish the tool change or reset the controller"),
    41: ("the spindle is not running", "switch the laser on first"),
    45: ("the emergency stop input is active", "release the emergency stop, then home the stage"),
    46: ("the axis has not been homed", "home the stage"),
    79: ("the emergency stop input is active", "release the emergency stop, then home the stage"),
}

ALARMS: dict[int, tuple[str, str]] = {
    1: ("the stage ran onto a limit switch", "free the carriage, check the travel, then home the stage"),
    2: ("a move would have left the stage's travel", "check start and length of the region, then home the stage"),
    3: ("the controller was reset while the stage moved, so its position is lost", "home the stage"),
    4: ("the probe was in the wrong state", "check the controller's wiring"),
    5: ("the probe did not touch", "check the controller's wiring"),
    6: ("homing was interrupted by a reset", "home the stage again"),
    7: ("homing was interrupted by the safety door", "close the door and home the stage again"),
    8: ("the home switch did not open when the stage backed off", "check the switch and the pull-off distance $27"),
    9: ("the home switch was not found", "check the switch, its cable, the direction $23 and the travel $130"),
    10: ("the emergency stop input is active", "release the emergency stop, then home the stage"),
    11: ("the controller demands homing", "home the stage"),
    12: ("a limit switch is pressed before the move", "free the carriage, then home the stage"),
    14: ("the spindle did not reach its speed", "check the laser's supply"),
    15: ("the axis could not be homed automatically", "check the home switches"),
    16: ("the controller's self test failed", "switch it off and on; replace it if that does not help"),
    17: ("a motor driver reports a fault", "check motor, driver and supply, then home the stage"),
}


def error_sentence(number: int) -> str:
    """``the controller is locked after an alarm (error:9); find the cause, then home the stage``."""
    what, do = ERRORS.get(number, ("the controller refused a command", "look the number up in its manual"))
    return f"{what} (error:{number}); {do}"


def alarm_sentence(number: int) -> str:
    what, do = ALARMS.get(number, ("the controller raised an alarm", "look the number up in its manual, then home"))
    return f"{what} (ALARM:{number}); {do}"
