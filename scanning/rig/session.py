"""One scan on one rig: home, light, step, expose, hand on; and whatever happens, dark and parked at the end.

The loop is limited by the hardware. The stage moves on as soon as the shutter has closed on a step's last exposure;
read-out and everything that is done with frames (storing, measuring) happens meanwhile, the latter in a second thread
behind a short queue. When that thread falls behind the loop waits and says how long; when it fails the scan ends with
its error.

Safety is this file's other half: there is one `finally` in `acquire`; it switches the laser off and parks the stage,
each is attempted even when the other failed, and nothing that is raised inside can pass it by."""

from __future__ import annotations

import logging
import math
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np

from scanning.errors import BadInput, CameraFault, RigFault, Stopped
from scanning.rig.protocols import Frame, LinkQuality, OverlappingCamera, OverlappingStage, SensorMode
from scanning.rig.rig import Rig

log = logging.getLogger(__name__)

Order = Literal["run", "pause", "cancel", "finish"]
OnFrames = Callable[[int, list[Frame]], None]

#: Steps that may wait for the sink. More would only hide for longer that it is too slow.
QUEUED_STEPS = 4
#: How often a paused scan looks whether it may go on, in seconds.
PAUSE_LOOK_S = 0.25
#: Every scan position is approached from this far below, so that the play of the screw lies always on the same side.
APPROACH_UM = 100.0
#: Steps of a scan that may be taken again after a bad frame, as a share of all steps (at least one). Beyond it the
#: camera or its network is faulty and a person should look.
RETAKE_SHARE = 0.01


class Clock(Protocol):
    def monotonic(self) -> float: ...
    def sleep(self, seconds: float) -> None: ...


class RealClock:
    monotonic = staticmethod(time.monotonic)
    sleep = staticmethod(time.sleep)


class Control(Protocol):
    """What a person wants of the running scan. Read once per step; must be quick."""

    def read(self) -> Order: ...


@dataclass(frozen=True)
class ScanPlan:
    """What to scan. ``steps`` stage positions, ``motor_steps`` motor steps apart (17 x 0.49 um = 8.33 um).

    ``exposures_us`` ascends; a logarithmic camera has exactly one, 0. ``first_step`` > 0 continues a scan whose
    earlier steps exist already. ``settle_s`` is waited at standstill before the first exposure of a step.
    ``frame_timeout_s`` is how long a frame may take beyond its exposure."""

    start_mm: float
    steps: int
    exposures_us: tuple[float, ...]
    mode: SensorMode
    motor_steps: int = 17
    settle_s: float = 0.0
    first_step: int = 0
    frame_timeout_s: float = 5.0

    def check(self, rig: Rig) -> None:
        """Raise `BadInput` with one sentence when this plan cannot be carried out on ``rig``."""
        if not (self.steps >= 1 and self.motor_steps >= 1 and 0 <= self.first_step < self.steps):
            raise BadInput(
                f"A scan needs at least one step and one motor step per step and must begin inside itself; this one "
                f"has {self.steps} steps of {self.motor_steps} motor steps and begins at step {self.first_step}."
            )
        if not self.exposures_us or not all(math.isfinite(e) and e >= 0 for e in self.exposures_us):
            raise BadInput("A scan needs at least one exposure time, in microseconds, none of them negative.")
        if list(self.exposures_us) != sorted(set(self.exposures_us)):
            raise BadInput(f"The exposure times {list(self.exposures_us)} must ascend and differ; sort them.")
        if not all(math.isfinite(v) and v >= 0 for v in (self.settle_s, self.frame_timeout_s)):
            raise BadInput("Settling time and frame timeout must be numbers of seconds, not negative.")
        if self.mode.rows < 1 or self.mode.columns < 1:
            raise BadInput(f"A frame of {self.mode.rows} rows x {self.mode.columns} columns holds nothing; enlarge it.")
        first_mm, last_mm = self.start_mm, self.position_steps(self.steps - 1, rig) * rig.stage.step_um / 1000
        if not (math.isfinite(first_mm) and first_mm >= 0 and last_mm <= rig.stage.travel_mm):
            raise BadInput(
                f"The region lies at {first_mm:.2f} to {last_mm:.2f} mm but the stage of {rig.name} travels from 0 to "
                f"{rig.stage.travel_mm:g} mm; move the region or shorten it."
            )

    def position_steps(self, step: int, rig: Rig) -> int:
        """Stage position of one step, in motor steps from zero."""
        start = round(self.start_mm * 1000 / rig.stage.step_um) if math.isfinite(self.start_mm) else 0
        return start + step * self.motor_steps


@dataclass
class TimeBudget:
    """Where the time of a scan went, in seconds of wall clock; ``software_s`` is what is left of ``wall_s``.

    ``exposure_s`` holds what the sensor makes exposures wait for each other; ``setup_s`` is the configuration of the
    camera and the dark frame, ``parking_s`` everything after the last frame. ``readout_s`` is the read-out that was
    waited for; what was read out while the stage moved is part of ``motion_s`` and told beside it by ``overlapped_s``.
    """

    wall_s: float = 0.0
    setup_s: float = 0.0
    homing_s: float = 0.0
    motion_s: float = 0.0
    settle_s: float = 0.0
    exposure_s: float = 0.0
    readout_s: float = 0.0
    sink_wait_s: float = 0.0
    paused_s: float = 0.0
    parking_s: float = 0.0
    overlapped_s: float = 0.0

    @property
    def software_s(self) -> float:
        known: float = sum(value for name, value in vars(self).items() if name not in ("wall_s", "overlapped_s"))
        return max(self.wall_s - known, 0.0)

    @property
    def software_share(self) -> float:
        """Time added by software, relative to motion and exposure."""
        hardware = self.motion_s + self.exposure_s
        return self.software_s / hardware if hardware > 0 else 0.0


@dataclass
class AcquisitionSummary:
    """What a scan did. ``steps_done`` counts from the beginning of the scan, including steps before ``first_step``."""

    steps_done: int = 0
    finished_early: bool = False
    pauses: int = 0
    retaken_frames: int = 0
    dark_level: float = math.nan
    """Median grey value of a frame with the laser off: dark level plus room light."""
    link: LinkQuality = field(default_factory=LinkQuality)
    time: TimeBudget = field(default_factory=TimeBudget)


def acquire(
    rig: Rig,
    plan: ScanPlan,
    *,
    on_frames: OnFrames,
    control: Control,
    clock: Clock | None = None,
) -> AcquisitionSummary:
    """Scan and return when the rig is dark and parked.

    ``on_frames(step, frames)`` gets the frames of each step, shortest exposure first, in order of steps, in one other
    thread (open and close thread-bound things such as database connections there, or do not use them). Its exception
    ends the scan and comes out of here. ``control`` is read in the calling thread.

    Raises `BadInput` for a plan that cannot be carried out, before anything moves; `RigFault` when hardware fails;
    `Stopped` when cancelled. A scan that is finished early returns normally.
    """
    clock = clock or RealClock()
    plan.check(rig)
    scan = _Scan(rig, plan, control, clock)
    began = clock.monotonic()
    sink = _Sink(on_frames)
    failure: BaseException | None = None
    ended = began
    try:
        scan.run(sink)
    except BaseException as fault:  # raised again below, when the rig is safe
        failure = fault
    finally:
        ended = clock.monotonic()
        # The light goes out before anything is waited for.
        failure = _attempt(failure, lambda: _darken(rig), "switch the laser off")
        failure = _attempt(failure, lambda: scan.keep_last_step(sink), "keep the frames of the last step")
        failure = _attempt(failure, lambda: _park(rig), "park the stage")
        failure = _attempt(failure, sink.finish, "hand on the last frames")
        scan.summary.time.parking_s = clock.monotonic() - ended
        scan.summary.time.wall_s = clock.monotonic() - began
        scan.summary.link = rig.stage.link_quality()
    if failure is not None:
        raise failure
    return scan.summary


def _attempt(failure: BaseException | None, act: Callable[[], None], what: str) -> BaseException | None:
    """Do one thing that must be tried, and keep the first failure with later ones noted on it.

    A signal that lands in here (a worker being stopped) must not skip what comes after, so it too is only kept.
    """
    for _ in range(2):  # a signal may hit between two lines of a cleanup; try once more before giving up on it
        try:
            act()
            return failure
        except RigFault as fault:
            log.error("could not %s: %s", what, fault)
            if failure is None:
                return fault
            failure.add_note(f"Afterwards it was not possible to {what}: {fault}")
            return failure
        except Exception as fault:
            log.exception("could not %s", what)
            if failure is None:
                return fault
            failure.add_note(f"Afterwards it was not possible to {what}: {fault}")
            return failure
        except BaseException as signal:
            failure = failure or signal
    return failure


def _darken(rig: Rig) -> None:
    try:
        rig.laser.off()
    except Exception:
        rig.stage.emergency_stop()  # another way to the same end; the fault is still told
        raise


def _park(rig: Rig) -> None:
    """Park if the stage knows where it is; one that lost its position stays put, that is the safe thing."""
    try:
        _ = rig.stage.position_steps
    except RigFault:
        log.warning("%s is not parked because its stage does not know where it is", rig.name)
        return
    rig.stage.park()


class _Scan:
    """The loop itself. Makes things happen; `acquire` makes them end."""

    def __init__(self, rig: Rig, plan: ScanPlan, control: Control, clock: Clock) -> None:
        self.rig, self.plan, self.control, self.clock = rig, plan, control, clock
        self.summary = AcquisitionSummary(steps_done=plan.first_step)
        self._last_id: int | None = None
        self._unread: int | None = None  # a step whose frames are still in the camera
        self._read: list[Frame] | CameraFault | None = None  # what reading it out on the way gave
        self._retakes_left = max(1, int(plan.steps * RETAKE_SHARE))

    def run(self, sink: _Sink) -> None:
        plan, spent = self.plan, self.summary.time
        with _Stopwatch(self.clock, spent, "setup_s"):
            self.rig.camera.configure(plan.mode)
            self.rig.laser.off()
            # Before anything moves: a camera that sends nothing is found out here.
            dark = self._checked(self._grab(plan.exposures_us[0]), plan.exposures_us[0])
        self.summary.dark_level = float(np.median(dark.image))
        step = plan.first_step
        self._take_place(step)
        while step < plan.steps:
            order = self.control.read()
            if order != "run":
                self._collect(sink)
                if order == "pause":
                    order = self._pause(step)
                if order == "cancel":
                    raise Stopped(f"The scan was stopped at step {step} of {plan.steps}; the rig is dark and parked.")
                if order == "finish":
                    self.summary.finished_early = True
                    break
            self._move_on(step)
            self._collect(sink)
            self._expose(step, sink)
            step += 1
        self._collect(sink)

    def _move_on(self, step: int) -> None:
        """Go to ``step``, reading out the frames of the step before on the way where the stage allows it."""
        stage, position = self.rig.stage, self.plan.position_steps(step, self.rig)
        with _Stopwatch(self.clock, self.summary.time, "motion_s"):
            if isinstance(stage, OverlappingStage):
                stage.move_to_while(position, self._read_out_on_the_way)
            else:
                stage.move_to(position)

    def _take_place(self, step: int) -> None:
        """Home, go to the approach side of ``step``, and only then light up."""
        with _Stopwatch(self.clock, self.summary.time, "homing_s"):
            self.rig.stage.home()
            self._approach(step)
            self.rig.laser.on()
            if self.rig.warm_up_s:
                self.clock.sleep(self.rig.warm_up_s)

    def _approach(self, step: int) -> None:
        """Go below ``step`` so that it is reached in the direction of the scan."""
        back = round(APPROACH_UM / self.rig.stage.step_um)
        self.rig.stage.move_to(max(self.plan.position_steps(step, self.rig) - back, 0))

    def _pause(self, step: int) -> Order:
        """Dark and parked until told otherwise; on ``run`` re-home and stand ready for exactly ``step``."""
        self.summary.pauses += 1
        with _Stopwatch(self.clock, self.summary.time, "paused_s"):
            self.rig.laser.off()
            self.rig.stage.park()
            while (order := self.control.read()) == "pause":
                self.clock.sleep(PAUSE_LOOK_S)
        if order == "run":
            self._take_place(step)
        return order

    def _expose(self, step: int, sink: _Sink) -> None:
        plan, camera, spent = self.plan, self.rig.camera, self.summary.time
        if plan.settle_s:
            with _Stopwatch(self.clock, spent, "settle_s"):
                self.clock.sleep(plan.settle_s)
        try:
            if isinstance(camera, OverlappingCamera):
                with _Stopwatch(self.clock, spent, "exposure_s"):
                    for exposure_us in plan.exposures_us:
                        camera.expose(exposure_us, timeout_s=plan.frame_timeout_s)
                self._unread = step
            else:
                with _Stopwatch(self.clock, spent, "exposure_s"):
                    frames = [self._checked(self._grab(e), e) for e in plan.exposures_us]
                self._hand_on(step, frames, sink)
        except CameraFault as fault:
            self._retake(step, fault, sink)

    def _collect(self, sink: _Sink) -> None:
        """Read out the step the camera still holds; the stage may have moved on meanwhile."""
        if self._unread is None:
            return
        step, read = self._unread, self._read
        self._unread = self._read = None
        if read is None:
            with _Stopwatch(self.clock, self.summary.time, "readout_s"):
                read = self._read_out()
        if isinstance(read, CameraFault):
            here = self.rig.stage.position_steps
            self._retake(step, read, sink)
            if here != self.rig.stage.position_steps:
                with _Stopwatch(self.clock, self.summary.time, "motion_s"):
                    self.rig.stage.move_to(here)
            return
        self._hand_on(step, read, sink)

    def keep_last_step(self, sink: _Sink) -> None:
        """Hand on a step that was exposed whole before something else failed. Moves nothing, takes nothing again.

        An overlapping stage checks where it stands before it sets out again; until then a step's place is not certain.
        """
        step, read = self._unread, self._read
        self._unread = self._read = None
        if step is None:
            return
        if read is None and isinstance(self.rig.stage, OverlappingStage):
            log.warning("the frames of step %d are not kept: nothing vouches for the place they were taken at", step)
            return
        if read is None:
            read = self._read_out()
        if isinstance(read, CameraFault):
            log.warning("the frames of step %d are lost: %s", step, read)
            return
        self._hand_on(step, read, sink)

    def _read_out_on_the_way(self) -> None:
        if self._unread is not None:
            with _Stopwatch(self.clock, self.summary.time, "overlapped_s"):
                self._read = self._read_out()

    def _read_out(self) -> list[Frame] | CameraFault:
        """The bracket that the camera holds, or why it cannot be trusted. Moves nothing."""
        camera, plan = self.rig.camera, self.plan
        assert isinstance(camera, OverlappingCamera)
        try:
            return [
                self._checked(camera.read_out(timeout_s=plan.frame_timeout_s), exposure_us)
                for exposure_us in plan.exposures_us
            ]
        except CameraFault as fault:
            return fault

    def _retake(self, step: int, fault: CameraFault, sink: _Sink) -> None:
        """Take a step's bracket once more, at its own place reached from its own side."""
        if self._retakes_left <= 0:
            raise fault
        self._retakes_left -= 1
        self.summary.retaken_frames += 1
        log.warning("step %d is taken again: %s", step, fault)
        with _Stopwatch(self.clock, self.summary.time, "readout_s"):
            self.rig.camera.configure(self.plan.mode)  # also forgets what the camera still holds
            self._approach(step)
            self.rig.stage.move_to(self.plan.position_steps(step, self.rig))
            frames = [self._checked(self._grab(e), e) for e in self.plan.exposures_us]
        self._hand_on(step, frames, sink)

    def _grab(self, exposure_us: float) -> Frame:
        return self.rig.camera.grab(exposure_us, timeout_s=self.plan.frame_timeout_s)

    def _checked(self, frame: Frame, exposure_us: float) -> Frame:
        mode = self.plan.mode
        if frame.image.shape != (mode.rows, mode.columns):
            raise CameraFault(
                f"The camera sent a frame of {'x'.join(map(str, frame.image.shape))} pixels instead of "
                f"{mode.rows}x{mode.columns}; check the camera's region of interest."
            )
        if frame.image.dtype != (np.uint8 if mode.bits <= 8 else np.uint16):
            raise CameraFault(
                f"The camera sent pixels of type {frame.image.dtype} instead of {mode.bits} bits; "
                "check its pixel format."
            )
        if frame.exposure_us != exposure_us:
            raise CameraFault(
                f"The camera exposed for {frame.exposure_us:g} us instead of {exposure_us:g} us; "
                "check its exposure range."
            )
        if self._last_id is not None and frame.frame_id <= self._last_id:
            raise CameraFault(
                f"The camera is stuck: it sent frame {frame.frame_id} after frame {self._last_id}; restart the camera."
            )
        self._last_id = frame.frame_id
        return frame

    def _hand_on(self, step: int, frames: list[Frame], sink: _Sink) -> None:
        with _Stopwatch(self.clock, self.summary.time, "sink_wait_s"):
            sink.put(step, frames)
        self.summary.steps_done = step + 1


class _Stopwatch:
    """Adds the time spent inside to one entry of the budget."""

    def __init__(self, clock: Clock, budget: TimeBudget, name: str) -> None:
        self._clock, self._budget, self._name = clock, budget, name

    def __enter__(self) -> None:
        self._began = self._clock.monotonic()

    def __exit__(self, *_: object) -> None:
        spent = self._clock.monotonic() - self._began
        setattr(self._budget, self._name, getattr(self._budget, self._name) + spent)


class _Sink:
    """Runs ``on_frames`` in its own thread behind a short queue."""

    def __init__(self, on_frames: OnFrames) -> None:
        self._on_frames = on_frames
        self._queue: queue.Queue[tuple[int, list[Frame]] | None] = queue.Queue(QUEUED_STEPS)
        self._failed: BaseException | None = None
        self._over = False
        self._thread = threading.Thread(target=self._work, name="frame-sink", daemon=True)
        self._thread.start()

    def put(self, step: int, frames: list[Frame]) -> None:
        while True:
            if self._failed is not None:
                raise self._failed
            try:
                self._queue.put((step, frames), timeout=0.2)
            except queue.Full:  # look again whether the sink is still alive
                continue
            return

    def finish(self) -> None:
        """Wait until everything handed over is done; raise what the sink raised."""
        if not self._over:
            self._over = True
            self._queue.put(None)
        self._thread.join()
        if self._failed is not None:
            failed, self._failed = self._failed, None
            raise failed

    def _work(self) -> None:
        while (item := self._queue.get()) is not None:
            if self._failed is None:
                try:
                    self._on_frames(*item)
                except BaseException as fault:  # carried over to the scan's thread, which raises it
                    self._failed = fault
