"""One claimed scan, from the open rig to the stored frames, and the true state it ends in.

Whatever happens in between (a person cancels, the camera falls silent, the worker is told to go, the database is gone)
there is exactly one way out for each, every one of them with the rig dark and parked by the session's own ``finally``,
the frames taken so far on the disk, and a sentence in the row that says what a person should do.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from django.conf import settings
from django.db import DatabaseError, OperationalError, connection, transaction
from django.utils import timezone

from inspection.models import Rig as RigRow
from inspection.models import Scan
from inspection.services.audit import audit
from inspection.services.calibrations import calibration_of
from inspection.services.queue import pause_queue_for_fault
from inspection.services.recipes import recipe_of
from inspection.services.results import pending_range_file, save_range_image
from inspection.services.ring import ring_measure
from inspection.states import ScanState
from scanning import optics
from scanning.calibration import Calibration
from scanning.errors import BadInput, Fault, Stopped
from scanning.frames import StackHeader
from scanning.recipe import Recipe
from scanning.rig.protocols import Frame, SensorMode
from scanning.rig.rig import Rig, open_rig
from scanning.rig.session import AcquisitionSummary, Order, ScanPlan, acquire
from scanning.stacks import PART_SUFFIX, StackWriter, open_stack
from worker.emergency import EmergencyStopped, StopLine
from worker.lease import Lease, LeaseLostError, drop_connection
from worker.live import LiveRangeImage
from worker.stopping import Watch

log = logging.getLogger(__name__)

#: Nobody reads faster, and every write is a disk's work.
PROGRESS_EVERY_S = 0.5
#: What of a rig's configuration describes hardware; the rest of it is ours (sensor, system, recipe, simulated).
HARDWARE = ("stage", "laser", "camera")

OpenRig = Callable[[Mapping[str, Any]], AbstractContextManager[Rig]]


class WorkerGoingDown(Exception):
    """The worker must end; the scan is given up at this step."""


class Orders:
    """What people and the machine want of the running scan: the session's ``Control``, read once per step.

    One short query; no broker. A database that does not answer counts as "go on" until the lease has run out.
    """

    def __init__(
        self,
        lease: Lease,
        done: Callable[[], int],
        *,
        watch: Watch | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._lease = lease
        self._done = done
        self._watch = watch or Watch()
        self._clock = clock
        self._written_at = -PROGRESS_EVERY_S
        self._last: Order = "run"
        self.paused = False

    def read(self) -> Order:
        self._lease.check()
        if reason := self._watch.reason():
            raise WorkerGoingDown(reason)
        try:
            order = self._asked()
            self._show(order)
        except DatabaseError as error:
            log.warning("Scan %s goes on without the database: %s", self._lease.scan_id, error)
            drop_connection()
            return self._last
        self._last = order
        return order

    def _asked(self) -> Order:
        row = (
            Scan.objects.filter(pk=self._lease.scan_id, lease_token=self._lease.token)
            .values_list("cancel_requested_at", "finish_requested_at", "pause_requested_at", "stop_requested_at")
            .first()
        )
        if row is None:
            raise LeaseLostError(f"scan {self._lease.scan_id} was taken over")
        cancel, finish, pause, stop = row
        if stop:
            raise EmergencyStopped
        return "cancel" if cancel else "finish" if finish else "pause" if pause else "run"

    def _show(self, order: Order) -> None:
        """Write the state and, twice a second at most, the progress."""
        now = timezone.now()
        if order == "pause" and self._last == "pause" and not self.paused:
            # Asked a second time: the session has darkened and parked the rig in between.
            self._lease.move(ScanState.RUNNING, ScanState.PAUSED, phase="paused", done=self._done(), progress_at=now)
            self.paused = True
        elif order != "pause" and self.paused:
            self._lease.move(ScanState.PAUSED, ScanState.RUNNING, phase="scanning", progress_at=now)
            self.paused = False
        elif self._clock() - self._written_at >= PROGRESS_EVERY_S:
            self._written_at = self._clock()
            phase = "scanning" if order == "run" else "paused" if self.paused else "stopping"
            self._lease.write(done=self._done(), phase=phase, progress_at=now)


class Frames:
    """Takes the frames of each step both ways at once: onto the disk and through the recipe. Knows no database."""

    def __init__(self, place: Path, header: Callable[[], StackHeader], recipe: Recipe, calibration: Calibration | None):
        self._place = place
        self._header = header
        self._recipe = recipe
        self._calibration = calibration
        self._writer: StackWriter | None = None
        self._image: LiveRangeImage | None = None
        self._replayed: StackHeader | None = None
        self._lock = threading.Lock()
        self.done = 0

    def take(self, step: int, frames: list[Frame]) -> None:
        """The session's ``on_frames``; called in its own thread."""
        if self._writer is None:
            header = self._header()
            self._writer = StackWriter(self._place, header)
            self._image = LiveRangeImage(self._recipe, header, self._calibration)
        assert self._image is not None
        images = [frame.image for frame in frames]
        self._writer.append(images)
        self._image.push(images)
        with self._lock:
            self.done = step + 1

    def replay(self, earlier: Path, steps: int, check: Callable[[], None]) -> int:
        """Take over the whole frames of a recording that broke off; return how many steps of ``steps`` they are.

        Every frame passes its checksum or is taken again by the rig: the first that does not ends the replay. The new
        part is on the disk when this returns, so that the earlier file can go.
        """
        with open_stack(earlier) as stack:
            header = replace(stack.header, steps=steps)
            for index in range(min(stack.header.steps, steps)):
                try:
                    images = stack.step(index)
                except BadInput as damaged:
                    log.warning("%s; the scan goes on from there.", damaged)
                    break
                if self._writer is None:
                    self._writer = StackWriter(self._place, header)
                    self._image = LiveRangeImage(self._recipe, header, self._calibration)
                self._writer.append(images)
                assert self._image is not None
                self._image.push(images)
                self.done = index + 1
                check()
        if self._writer is not None:
            self._replayed = header
            with self._writer.part.open("rb") as part:
                os.fsync(part.fileno())
        return self.done

    def check_header(self) -> None:
        """Refuse to add frames of another kind to those replayed; a stack has one header."""
        if self._replayed is not None and (now := self._header()) != self._replayed:
            different = [name for name, value in asdict(now).items() if value != asdict(self._replayed)[name]]
            raise BadInput(
                f"The rig has changed since the scan broke off ({', '.join(different)}), so its frames would not fit; "
                f"scan the region again."
            )

    def finish_image(self) -> LiveRangeImage:
        if self._image is None:
            raise BadInput("The scan ended before its first step, so there is nothing to measure; scan again.")
        return self._image

    def keep(self) -> str:
        """Complete the stack with the steps there are and return its hash; empty if there are none."""
        if self._writer is None or self._writer.steps_written == 0:
            self.leave()
            return ""
        self._writer.finish()
        with open_stack(self._place) as stack:
            return stack.sha256()

    def leave(self) -> None:
        """Close the unfinished stack as it is; its completed steps stay readable."""
        if self._writer is not None:
            self._writer.close()


def run_scan(lease: Lease, *, opening: OpenRig = open_rig, watch: Watch | None = None) -> str:
    """Carry out the claimed scan and return the state it is left in (`ScanState`, or "lost" when it is not ours)."""
    scan = Scan.objects.select_related("rig", "region__tool", "recipe", "calibration").get(pk=lease.scan_id)
    return _Run(lease, scan, opening, watch or Watch()).go()


class _Run:
    def __init__(self, lease: Lease, scan: Scan, opening: OpenRig, watch: Watch) -> None:
        self.lease = lease
        self.scan = scan
        self.opening = opening
        self.watch = watch
        suffix = f"-{scan.continued}" if scan.continued else ""
        self.place = f"{timezone.now():%Y/%m}/scan-{scan.pk}{suffix}.h5"
        #: The frames to go on from; "" once they are taken over.
        self.earlier = scan.stack_file if scan.continued else ""
        self.first_step = 0
        self.line: StopLine | None = None
        self.frames: Frames | None = None
        self.orders: Orders | None = None

    def go(self) -> str:
        try:
            with self.lease.beating():
                return self._scan()
        except LeaseLostError as lost:
            log.error("%s; the rig is parked, and nothing more is written about it.", lost)
            self._close()
            return "lost"

    def _scan(self) -> str:
        try:
            summary = self._acquired()
            return self._hand_over(summary)
        except EmergencyStopped:
            who = self._stopped_by()
            return self._end(
                ScanState.INTERRUPTED,
                f"Emergency stop{f' by {who}' if who else ''} at step {self._done()} of {self.scan.total}: the stage "
                f"was halted, the laser is off. Look at the rig, then continue the scan or resume the queue.",
            )
        except Stopped:
            return self._end(ScanState.CANCELLED, "")
        except WorkerGoingDown as reason:
            return self._end(
                ScanState.INTERRUPTED,
                f"{str(reason).capitalize()} at step {self._done()} of {self.scan.total}; the rig is dark and parked, "
                f"so resume the queue and scan again.",
            )
        except Fault as fault:
            return self._end(ScanState.FAILED, str(fault))
        except LeaseLostError:
            raise
        except Exception as error:
            log.exception("Scan %s failed.", self.scan.pk)
            return self._end(
                ScanState.FAILED,
                f"An unforeseen {type(error).__name__} ended the scan ({error}); the worker's log has the details.",
            )
        except BaseException:
            self._end(
                ScanState.INTERRUPTED,
                f"The worker was stopped at step {self._done()} of {self.scan.total}; look at the rig, then resume the "
                f"queue and scan again.",
            )
            raise

    def _done(self) -> int:
        return self.frames.done if self.frames is not None else 0

    def _stopped_by(self) -> str:
        by = Scan.objects.select_related("stop_requested_by").get(pk=self.scan.pk).stop_requested_by
        return str(by) if by else ""

    def _acquired(self) -> AcquisitionSummary:
        """`_acquire`, with whatever an emergency stop made of it called by its name."""
        try:
            return self._acquire()
        except (LeaseLostError, EmergencyStopped):
            raise
        except Exception as error:
            if self.line is not None and self.line.pressed:
                raise EmergencyStopped from error
            raise

    def _acquire(self) -> AcquisitionSummary:
        scan, plan = self.scan, self.scan.plan
        recipe, calibration = recipe_of(scan.recipe), calibration_of(scan.calibration)
        target = Path(settings.STACKS) / self.place
        if target.exists():
            raise BadInput(f"There is already a stack {self.place}; move it away, then scan again.")
        opened: list[Rig] = []
        self.frames = Frames(target, lambda: header_of(scan.rig, plan, opened[0], calibration), recipe, calibration)
        if self.earlier:
            self._take_over()
        # The row names the part before there is one, so that a killed worker's frames are found.
        self.lease.write(stack_file=self.place + PART_SUFFIX, total=plan["steps"], done=self.first_step)
        if self.earlier:
            (Path(settings.STACKS) / self.earlier).unlink(missing_ok=True)
            self.earlier = ""
        if self.first_step == plan["steps"]:  # it broke off between the last frame and the hand-over
            return AcquisitionSummary(steps_done=self.first_step)
        config = {part: scan.rig.config[part] for part in HARDWARE if part in scan.rig.config}
        with self.opening({"name": scan.rig.name, **config}) as rig:
            opened.append(rig)
            put_part_on(rig, plan)
            self.frames.check_header()
            self.orders = Orders(self.lease, self._done, watch=self.watch)
            with StopLine(self.lease, rig.stage) as self.line:
                return acquire(
                    rig,
                    replace(scan_plan(scan.rig, plan), first_step=self.first_step),
                    on_frames=self.frames.take,
                    control=self.orders,
                )

    def _take_over(self) -> None:
        """Verify the frames of the recording that broke off and copy them into the new one."""
        assert self.frames is not None

        def check() -> None:
            self.lease.check()
            if reason := self.watch.reason():
                raise WorkerGoingDown(reason)

        self.lease.write(phase="verifying")
        try:
            self.first_step = self.frames.replay(
                Path(settings.STACKS) / self.earlier, int(self.scan.plan["steps"]), check
            )
        except BadInput as unreadable:
            if self.frames.done:
                raise
            log.warning("Scan %s starts clean: %s", self.scan.pk, unreadable)

    def _hand_over(self, summary: AcquisitionSummary) -> str:
        """The last frame is in and the rig is parked: the range image to its file, the scan to the compute workers."""
        assert self.frames is not None
        image = self.frames.finish_image().finish()
        save_range_image(image, pending_range_file(self.scan.pk))
        sha256 = self.frames.keep()
        self._insist(lambda: self._store_acquired(summary, sha256))
        return ScanState.PROCESSING

    def _store_acquired(self, summary: AcquisitionSummary, sha256: str) -> None:
        now = timezone.now()
        partial = summary.steps_done < self.scan.plan["steps"]
        with transaction.atomic():
            if self.orders is not None and self.orders.paused:  # finished early out of a pause
                self.lease.move(ScanState.PAUSED, ScanState.RUNNING)
            self.lease.move(
                ScanState.RUNNING,
                ScanState.PROCESSING,
                done=summary.steps_done,
                partial=partial,
                phase="surface",
                message="",
                progress_at=now,
                stack_file=self.place,
                stack_sha256=sha256,
                acquisition={
                    **described(summary),
                    **({"continued_at_step": self.first_step} if self.scan.continued else {}),
                },
                lease_token=None,
                lease_until=None,
                attempts=0,
            )
            audit(None, "scan.acquired", self.scan, after={"steps": summary.steps_done, "sha256": sha256})
            ring_measure(self.scan.pk)

    def _insist(self, store: Callable[[], None]) -> None:
        """Store with patience: a database that restarts just now must not cost a finished scan."""
        while True:
            try:
                return store()
            except OperationalError as error:
                self.lease.check()
                log.warning("The end of scan %s waits for the database: %s", self.scan.pk, error)
                connection.close()
                time.sleep(PROGRESS_EVERY_S)

    def _end(self, state: str, fault: str) -> str:
        """Leave the scan in ``state`` with its frames; any end but a cancelled one pauses the queue with the reason."""
        stored = self._keep()
        self._insist(lambda: self._store_end(state, fault, stored))
        return state

    def _store_end(self, state: str, fault: str, stored: dict[str, str]) -> None:
        with transaction.atomic():
            now = timezone.now()
            frm = ScanState.PAUSED if self.orders is not None and self.orders.paused else ScanState.RUNNING
            self.lease.move(
                frm,
                state,
                fault=fault[:500],
                finished_at=now,
                progress_at=now,
                done=self._done(),
                partial=True,
                phase="",
                lease_token=None,
                lease_until=None,
                **stored,
            )
            if state != ScanState.CANCELLED:
                pause_queue_for_fault(self.scan.rig_id, f"{self.scan.region} {state}: {fault}")
            audit(None, f"scan.{state}", self.scan, reason=fault)

    def _keep(self) -> dict[str, str]:
        """Complete the stack of an ended scan; the row's columns about it."""
        if self.earlier:  # not taken over yet: the new part is of no use, the earlier frames stay what there is
            self._close()
            (Path(settings.STACKS) / (self.place + PART_SUFFIX)).unlink(missing_ok=True)
            return {"stack_file": self.earlier}
        if self._done() == 0 or self.frames is None:
            self._close()
            part = Path(settings.STACKS) / (self.place + PART_SUFFIX)
            part.unlink(missing_ok=True)
            return {"stack_file": "", "stack_sha256": ""}
        try:
            return {"stack_sha256": self.frames.keep(), "stack_file": self.place}
        except (Fault, OSError) as error:  # a full disk: the part with its completed steps is what remains
            log.error("The stack of scan %s could not be completed: %s", self.scan.pk, error)
            self._close()
            return {"stack_file": self.place + PART_SUFFIX}

    def _close(self) -> None:
        if self.frames is not None:
            self.frames.leave()


def put_part_on(rig: Rig, plan: Mapping[str, Any]) -> None:
    """What a person does at a real rig: lay the tool on. On a simulated one the plan says which part it is."""
    load = getattr(rig.camera, "load_part", None)
    if load is not None and "part" in plan:
        load(**plan["part"], start_mm=plan["start_mm"])


def sensor_of(rig: RigRow, plan: Mapping[str, Any]) -> SensorMode:
    """The region of interest the plan asks for; bits are the rig's."""
    return SensorMode(
        rows=int(plan["rows"]),
        columns=int(plan["columns"]),
        row_offset=int(plan["row_offset"]),
        column_offset=int(plan.get("column_offset", 0)),
        bits=int(rig.config.get("sensor", {}).get("bits", 8)),
    )


def scan_plan(rig: RigRow, plan: Mapping[str, Any]) -> ScanPlan:
    """The frozen order in the session's words."""
    return ScanPlan(
        start_mm=float(plan["start_mm"]),
        steps=int(plan["steps"]),
        exposures_us=tuple(float(value) for value in plan["exposures_us"]),
        mode=sensor_of(rig, plan),
        motor_steps=int(plan["motor_steps_per_profile"]),
        settle_s=float(rig.config.get("settle_s", 0.0)),
    )


def header_of(row: RigRow, plan: Mapping[str, Any], rig: Rig, calibration: Calibration | None) -> StackHeader:
    """What the stack must know about itself. The height scale is the calibration's, else the imaging system's own."""
    name = str(row.config.get("system", "IS1"))
    system = optics.SYSTEMS.get(name)
    if system is None:
        raise BadInput(f"{row.name} names the imaging system {name!r}; the known ones are {', '.join(optics.SYSTEMS)}.")
    mode = sensor_of(row, plan)
    exposures = tuple(float(value) for value in plan["exposures_us"])
    return StackHeader(
        rows=mode.rows,
        columns=mode.columns,
        steps=int(plan["steps"]),
        exposures_us=exposures,
        step_um=int(plan["motor_steps_per_profile"]) * rig.stage.step_um,
        row_pitch_um=system.row_pitch_um,
        mm_per_pixel=abs(calibration.slope_mm_per_px) if calibration is not None else system.mm_per_pixel,
        saturation=rig.camera.saturation,
        line_width_px=system.on_sensor_px(optics.LINE_WIDTH_UM),
        response="logarithmic" if exposures == (0.0,) else "linear",
        bits=8 if mode.bits <= 8 else 16,
    )


def described(summary: AcquisitionSummary) -> dict[str, Any]:
    """Time budget and link quality of a run, as kept with the scan."""
    budget = {name: round(value, 4) for name, value in asdict(summary.time).items()}
    return {
        "duration_s": budget["wall_s"],
        "time": {**budget, "software_s": round(summary.time.software_s, 4)},
        "software_share": round(summary.time.software_share, 4),
        "link": asdict(summary.link),
        "pauses": summary.pauses,
        "retaken_frames": summary.retaken_frames,
        "dark_level": summary.dark_level if summary.dark_level == summary.dark_level else None,
    }
