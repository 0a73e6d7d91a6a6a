"""The queue of a rig: ordering scans, changing their order, stopping them, and stopping the queue itself.

The rows are the queue. Everything a scan depends on (positions, exposures, recipe, calibration, limits) is frozen the
moment it is ordered; what a person asks of a running scan is a column that the worker reads once per step, because a
message could be lost and a signal would skip the code that turns the laser off.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

from django.db import transaction
from django.db.models import Max, Min
from django.utils import timezone

from inspection.models import Inspection, LimitSet, Recipe, Recomputation, Region, Rig, Scan, Tool, User
from inspection.services.audit import audit
from inspection.services.moves import WrongState, move
from inspection.services.recipes import WINDOW, recipe_named, recipe_of, recipe_row, usual_recipe
from inspection.services.ring import ring, ring_recompute
from inspection.states import ENDED, ON_RIG, QueueState, ScanState
from scanning.errors import BadInput
from scanning.frames import StackHeader

#: Whole motor steps between two scan images: 17 x 0.49 um = 8.33 um (the paper, section 4.1).
MOTOR_STEPS_PER_PROFILE = 17
MOTOR_STEP_UM = 0.49
#: Sensor columns read out around the line when the rig does not say.
COLUMNS = 256
#: More than a minute per exposure is a typing error, not a dark tool.
LONGEST_EXPOSURE_US = 60_000_000.0


def enqueue_inspection(
    *,
    tool: Tool,
    rig: Rig,
    by: User | None,
    regions: Sequence[Region] | None = None,
    recipe: Recipe | None = None,
    reason: str = "",
    exposures_us: Sequence[float] | None = None,
) -> Inspection:
    """Put one scan per region at the end of the rig's queue and ring its worker after commit.

    ``regions`` defaults to the tool's active ones, ``exposures_us`` to the rig's bracket, ``recipe`` to what fits that
    bracket (`default_recipe`). ``by`` is None when a schedule orders. All scans are queued, or none: `BadInput` names
    the first region that lies outside the rig's travel, an inactive rig, a retired tool, a tool without regions, or a
    recipe that does not fit the exposures.
    """
    if not rig.active:
        raise BadInput(f"{rig.name} is out of service; choose another rig or put it back in service first.")
    if tool.status == Tool.Status.RETIRED:
        raise BadInput(f"Tool {tool.code} is retired; put it back in service before scanning it.")
    chosen = list(regions) if regions is not None else list(tool.regions.filter(active=True))
    if not chosen:
        raise BadInput(f"Tool {tool.code} has no region to scan; add one on the tool's page.")
    for region in chosen:
        if region.tool_id != tool.pk:
            raise BadInput(
                f"Region {region.name} belongs to another tool than {tool.code}; choose from its own regions."
            )
    exposures = check_exposures(exposures_us if exposures_us else rig.exposures_us, rig)
    recipe = recipe or default_recipe(rig, exposures)
    plans = [plan_for(region, rig, exposures, recipe) for region in chosen]
    now = timezone.now()
    with transaction.atomic():
        inspection = Inspection.objects.create(
            tool=tool, requested_by=by, requested_at=now, reason=reason[:200], life_used=tool.life_used
        )
        position = _last_position(rig)
        for offset, (region, plan) in enumerate(zip(chosen, plans, strict=True), start=1):
            _create_scan(inspection, region, rig, recipe, plan, position + offset, by)
        audit(
            by,
            "inspection.queued",
            inspection,
            after={"rig": rig.slug, "regions": [region.name for region in chosen], "recipe": recipe.name},
            reason=reason,
        )
        ring(rig.slug)
    return inspection


def _create_scan(
    inspection: Inspection,
    region: Region,
    rig: Rig,
    recipe: Recipe,
    plan: dict[str, Any],
    position: float,
    by: User | None,
) -> Scan:
    return Scan.objects.create(
        inspection=inspection,
        region=region,
        rig=rig,
        position=position,
        requested_by=by,
        queued_at=timezone.now(),
        plan=plan,
        recipe=recipe,
        calibration=rig.calibration_now(),
        limit_set=limits_in_force(inspection.tool),
        total=plan["steps"],
    )


def limits_in_force(tool: Tool) -> LimitSet | None:
    """The newest limit set of the tool's type; None if there is none."""
    return tool.tool_type.limit_sets.order_by("-version").first()


def check_exposures(exposures_us: Sequence[float], rig: Rig) -> list[float]:
    """Return the exposures ascending, in microseconds, or raise `BadInput`. A logarithmic camera has the single 0."""
    try:
        exposures = sorted(float(value) for value in exposures_us)
    except (TypeError, ValueError):
        raise BadInput(
            f"The exposures {exposures_us!r} are not all numbers; give microseconds, such as 100, 300."
        ) from None
    if not exposures:
        raise BadInput(f"{rig.name} has no exposures; enter its bracket in microseconds on the rig's page.")
    if not all(math.isfinite(value) and 0.0 <= value <= LONGEST_EXPOSURE_US for value in exposures):
        raise BadInput(f"An exposure of {exposures} us is outside 0 to {LONGEST_EXPOSURE_US:.0f} us.")
    if exposures[0] == 0.0 and len(exposures) > 1:
        raise BadInput("An exposure of 0 us stands for a logarithmic camera and cannot be part of a bracket.")
    if len(set(exposures)) != len(exposures):
        raise BadInput(f"The bracket {exposures} us holds an exposure twice; give each one once.")
    return exposures


def default_recipe(rig: Rig, exposures_us: Sequence[float]) -> Recipe:
    """The recipe an order uses when nobody says otherwise: the rig's own, or the usual one for its camera."""
    if named := rig.config.get("recipe"):
        return recipe_named(str(named))
    return recipe_row(usual_recipe("logarithmic" if exposures_us[0] == 0.0 else "linear", WINDOW))


def plan_for(region: Region, rig: Rig, exposures_us: Sequence[float], recipe: Recipe) -> dict[str, Any]:
    """Freeze where and how ``region`` is scanned on ``rig``. Raises `BadInput` if the rig or the recipe cannot.

    Keys: start_mm, length_mm, steps (scan images), motor_steps_per_profile, step_um, exposures_us, rows, row_offset,
    columns, column_offset, flat_row, flat_rows, region (its name).
    """
    sensor, stage = rig.config.get("sensor", {}), rig.config.get("stage", {})
    motor_step_um = float(stage.get("step_um", MOTOR_STEP_UM))
    step_um = MOTOR_STEPS_PER_PROFILE * motor_step_um
    if not (math.isfinite(region.start_mm) and math.isfinite(region.length_mm)) or region.length_mm <= 0:
        raise BadInput(f"Region {region.name} needs a start and a length above 0 mm; edit it on the tool's page.")
    steps = max(1, round(1000.0 * region.length_mm / step_um))
    end_mm = region.start_mm + (steps - 1) * step_um / 1000.0
    if region.start_mm < 0 or end_mm > rig.travel_mm:
        raise BadInput(
            f"Region {region.name} of {region.tool.code} reaches from {region.start_mm:g} to {end_mm:.2f} mm, "
            f"outside the 0 to {rig.travel_mm:g} mm that {rig.name} can travel; move or shorten the region."
        )
    plan = {
        "region": region.name,
        "start_mm": region.start_mm,
        "length_mm": region.length_mm,
        "steps": steps,
        "motor_steps_per_profile": MOTOR_STEPS_PER_PROFILE,
        "step_um": step_um,
        "exposures_us": list(exposures_us),
        "rows": region.rows,
        "row_offset": region.row_offset,
        "columns": int(sensor.get("columns", COLUMNS)),
        "column_offset": int(sensor.get("column_offset", 0)),
        "flat_row": region.flat_row,
        "flat_rows": region.flat_rows,
    }
    if (simulated := rig.config.get("simulated")) is not None:
        plan["part"] = part_for(region, simulated, str(rig.config.get("system", "IS1")))
    check_recipe(recipe, plan, f"Region {region.name} of {region.tool.code}")
    return plan


def part_for(region: Region, simulated: Mapping[str, Any], system: str) -> dict[str, Any]:
    """Which part lies on a simulated rig, in the words of its camera's ``load_part``.

    A real rig has a person who lays the tool on. Here ``simulated["parts"][tool code][region name]`` may say it (scene,
    seed, wear_um); else each tool is an individual of its own, and its regions R1 to R3 are the paper's.
    """
    from scanning.rig.simulated.scenes import SCENES

    tool = region.tool
    told = simulated.get("parts", {}).get(tool.code, {}).get(region.name, {})
    return {
        "scene": region.name if region.name in SCENES else "R1",
        "seed": zlib.crc32(tool.code.encode()) % 1_000_000,
        "wear_um": 0.0,
        "visit": tool.inspections.count(),
        "system": system,
        **told,
    }


def check_recipe(recipe: Recipe, plan: dict[str, Any], where: str) -> None:
    """Raise `BadInput` if the recipe cannot be used on the stack that ``plan`` will give."""
    working = recipe_of(recipe)
    exposures = tuple(plan["exposures_us"])
    working.check_fits(
        StackHeader(
            rows=plan["rows"],
            columns=plan["columns"],
            steps=plan["steps"],
            exposures_us=exposures,
            step_um=plan["step_um"],
            row_pitch_um=1.0,
            mm_per_pixel=1.0,
            response="logarithmic" if exposures == (0.0,) else "linear",
        )
    )
    if working.profiles(plan["steps"]) < 1:
        raise BadInput(
            f"{where} is {plan['steps']} steps long, too short for a single profile with {recipe.name}; lengthen the "
            f"region."
        )


def _last_position(rig: Rig) -> float:
    top = rig.scans.filter(state=ScanState.QUEUED).aggregate(top=Max("position"))["top"]
    return float(top) if top is not None else 0.0


def cancel_scan(scan: Scan, by: User | None) -> None:
    """Take a queued scan out of the queue, or ask the worker to stop a running one at its next step.

    A running scan stays running until its worker has parked the stage; its frames are kept, it gets no verdict.
    Raises `WrongState` for a scan that is neither queued nor on the rig.
    """
    now = timezone.now()
    who = f"Cancelled by {by}." if by else "Cancelled."
    with transaction.atomic():
        asked: dict[str, Any] = {"cancel_requested_at": now, "cancel_requested_by": by}
        if not move(
            scan.pk, frm=ScanState.QUEUED, to=ScanState.CANCELLED, finished_at=now, message=who, **asked
        ) and not Scan.objects.filter(pk=scan.pk, state__in=ON_RIG).update(**asked):
            _refuse(scan, "cancelled", "queued or running")
        audit(by, "scan.cancelled", scan)
    scan.refresh_from_db()


def pause_scan(scan: Scan, by: User | None) -> None:
    """Ask the worker to stop at the next step, laser off and stage parked, until the scan is resumed."""
    with transaction.atomic():
        if not Scan.objects.filter(pk=scan.pk, state=ScanState.RUNNING).update(pause_requested_at=timezone.now()):
            _refuse(scan, "paused", "running")
        audit(by, "scan.paused", scan)
    scan.refresh_from_db()


def resume_scan(scan: Scan, by: User | None) -> None:
    """Let a paused scan go on: its worker homes the stage again and continues at the step it stopped at."""
    with transaction.atomic():
        if not Scan.objects.filter(pk=scan.pk, state__in=ON_RIG, pause_requested_at__isnull=False).update(
            pause_requested_at=None
        ):
            _refuse(scan, "resumed", "paused")
        audit(by, "scan.resumed", scan)
    scan.refresh_from_db()


def finish_early(scan: Scan, by: User | None) -> None:
    """Ask the worker to end the scan at the next step and measure what there is. The result is marked partial."""
    with transaction.atomic():
        if not Scan.objects.filter(pk=scan.pk, state__in=ON_RIG).update(finish_requested_at=timezone.now()):
            _refuse(scan, "finished early", "running or paused")
        audit(by, "scan.finished_early", scan)
    scan.refresh_from_db()


def _refuse(scan: Scan, done: str, wanted: str) -> None:
    state = Scan.objects.values_list("state", flat=True).get(pk=scan.pk)
    raise WrongState(f"Scan {scan.pk} is {state}; only a {wanted} scan can be {done}.", state)


def move_scan(scan: Scan, by: User | None, where: str = "up") -> None:
    """Change a queued scan's place: one ``up`` or ``down``, to run ``next``, or ``last``."""
    if where not in ("up", "down", "next", "last"):
        raise BadInput(f"A scan cannot be moved {where!r}; it moves up, down, next or last.")
    with transaction.atomic():
        Rig.objects.select_for_update().get(pk=scan.rig_id)  # two people moving at once take turns
        queued = list(Scan.objects.filter(rig_id=scan.rig_id, state=ScanState.QUEUED).order_by("position", "pk"))
        order = [queued_scan.pk for queued_scan in queued]
        if scan.pk not in order:
            _refuse(scan, "moved", "queued")
        at = order.index(scan.pk)
        to = {"up": max(0, at - 1), "down": min(len(order) - 1, at + 1), "next": 0, "last": len(order) - 1}[where]
        order.insert(to, order.pop(at))
        for position, pk in enumerate(order, start=1):
            Scan.objects.filter(pk=pk, state=ScanState.QUEUED).update(position=position)
        audit(by, "scan.moved", scan, before={"place": at + 1}, after={"place": to + 1})
    scan.refresh_from_db()


def scan_again(scan: Scan, by: User | None) -> Scan:
    """Order a scan that has ended once more, as the next on its rig: the tool is usually still lying there.

    Positions, exposures and recipe are those of the old order; calibration and limits are those in force now.
    """
    if scan.source != Scan.Source.RIG:
        raise BadInput(f"Scan {scan.pk} was imported, not taken by a rig; compute it again or import it again.")
    if scan.state not in ENDED:
        _refuse(scan, "scanned again", "finished")
    if not scan.rig.active:
        raise BadInput(f"{scan.rig.name} is out of service; order the scan on another rig.")
    check_recipe(scan.recipe, scan.plan, str(scan.region))
    with transaction.atomic():
        first = scan.rig.scans.filter(state=ScanState.QUEUED).aggregate(first=Min("position"))["first"]
        again = _create_scan(
            scan.inspection, scan.region, scan.rig, scan.recipe, dict(scan.plan), (first or 1.0) - 1.0, by
        )
        audit(by, "scan.again", again, before={"scan": scan.pk})
        ring(scan.rig.slug)
    return again


def reprocess(scan: Scan, by: User | None, recipe: Recipe) -> Recomputation:
    """Order the scan's result to be computed again from its stack with ``recipe``. Earlier results stay.

    Raises `WrongState` while the scan is still going on, `BadInput` if its stack is gone or the recipe does not fit.
    """
    if scan.state not in ENDED:
        _refuse(scan, "computed again", "finished")
    if not scan.stack_file:
        raise BadInput(f"Scan {scan.pk} has no stored frames, so it cannot be computed again; scan the region again.")
    check_recipe(recipe, scan.plan, str(scan.region))
    with transaction.atomic():
        order = Recomputation.objects.create(scan=scan, recipe=recipe, requested_by=by, requested_at=timezone.now())
        audit(by, "scan.reprocessed", scan, after={"recipe": recipe.name})
        ring_recompute(order.pk)
    return order


def pause_queue(rig: Rig, by: User | None, reason: str) -> None:
    """Start nothing more on the rig until somebody resumes its queue; a running scan goes on.

    ``reason`` is demanded.
    """
    reason = _demand(reason, "Say why the queue is paused; whoever comes next reads it.")
    with transaction.atomic():
        changed = Rig.objects.filter(pk=rig.pk, queue_state=QueueState.READY).update(
            queue_state=QueueState.PAUSED, queue_reason=reason, queue_owner=by, queue_since=timezone.now()
        )
        if not changed:
            _refuse_queue(rig, "paused")
        audit(by, "queue.paused", rig, reason=reason)
    rig.refresh_from_db()


def pause_queue_for_fault(rig_id: int, reason: str) -> None:
    """Stop the queue because something went wrong on the rig. Under a lock the reason waits until it is unlocked."""
    with transaction.atomic():
        rig = Rig.objects.select_for_update().get(pk=rig_id)
        if rig.queue_state == QueueState.LOCKED:
            Rig.objects.filter(pk=rig_id).update(pause_under_lock=reason[:300])
        else:
            Rig.objects.filter(pk=rig_id).update(
                queue_state=QueueState.PAUSED, queue_reason=reason[:300], queue_owner=None, queue_since=timezone.now()
            )
        audit(None, "queue.paused", rig, reason=reason)


def resume_queue(rig: Rig, by: User | None) -> None:
    """Let a paused queue go on and ring its worker."""
    with transaction.atomic():
        before = Rig.objects.get(pk=rig.pk).queue_reason
        changed = Rig.objects.filter(pk=rig.pk, queue_state=QueueState.PAUSED).update(
            queue_state=QueueState.READY, queue_reason="", queue_owner=None, queue_since=timezone.now()
        )
        if not changed:
            _refuse_queue(rig, "resumed")
        audit(by, "queue.resumed", rig, before={"reason": before})
        ring(rig.slug)
    rig.refresh_from_db()


def lock_rig(rig: Rig, by: User | None, note: str) -> None:
    """Keep the rig still because somebody has their hands in it. Refused while a scan is on the rig.

    The worker's claim and this lock read the rig's row one after the other, so a scan cannot start in between.
    """
    note = _demand(note, "Say what is done at the rig (for example: cleaning the lens); everybody sees it.")
    with transaction.atomic():
        now = Rig.objects.select_for_update().get(pk=rig.pk)
        if now.queue_state == QueueState.LOCKED:
            _refuse_queue(rig, "locked")
        if now.scans.filter(source=Scan.Source.RIG, state__in=ON_RIG).exists():
            raise WrongState(f"A scan is on {rig.name}; cancel it or wait for its end before reaching in.", "running")
        under = now.queue_reason if now.queue_state == QueueState.PAUSED else ""
        Rig.objects.filter(pk=rig.pk).update(
            queue_state=QueueState.LOCKED,
            queue_reason=note,
            queue_owner=by,
            queue_since=timezone.now(),
            pause_under_lock=under,
        )
        audit(by, "rig.locked", rig, reason=note)
    rig.refresh_from_db()


def unlock_rig(rig: Rig, by: User | None) -> None:
    """Take the lock off. A queue that was paused before stays paused with its old reason; else its worker is rung."""
    with transaction.atomic():
        now = Rig.objects.select_for_update().get(pk=rig.pk)
        if now.queue_state != QueueState.LOCKED:
            _refuse_queue(rig, "unlocked")
        under = now.pause_under_lock
        Rig.objects.filter(pk=rig.pk).update(
            queue_state=QueueState.PAUSED if under else QueueState.READY,
            queue_reason=under,
            queue_owner=None,
            queue_since=timezone.now(),
            pause_under_lock="",
        )
        audit(by, "rig.unlocked", rig, before={"note": now.queue_reason, "by": str(now.queue_owner or "")})
        if not under:
            ring(rig.slug)
    rig.refresh_from_db()


def _refuse_queue(rig: Rig, done: str) -> None:
    now = Rig.objects.get(pk=rig.pk)
    raise WrongState(f"The queue of {now.name} is {now.queue_state}, so it cannot be {done}.", now.queue_state)


def _demand(text: str, sentence: str) -> str:
    text = text.strip()
    if not text:
        raise BadInput(sentence)
    return text[:300]
