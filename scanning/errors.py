"""The faults a person must act on.

Every one carries a single sentence that says what is wrong, where, and what to do. Pages and commands print that
sentence as it is; anything else that escapes is a bug of ours and may show a traceback.
"""

from __future__ import annotations


class Fault(Exception):
    """Something a person can put right. ``str(fault)`` is one clear sentence: what, where, what to do."""


class BadInput(Fault):
    """Data from outside that cannot be used: a broken stack, a wrong size, a NaN where a number must be."""


class RigFault(Fault):
    """The stage, camera or laser did not do what was asked, or cannot be reached."""


class StageFault(RigFault):
    """The motion controller refused, alarmed, reset or fell silent."""


class CameraFault(RigFault):
    """The camera sent nothing, an incomplete frame, or a frame of the wrong size."""


class Stopped(Exception):
    """A person asked the running scan to stop; the rig is parked and the laser is off."""
