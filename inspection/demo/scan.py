"""The demo knife's scan as `manage.py up` orders, follows and prints it.

It goes through the same service, queue, worker, serial port and page as any other scan; nothing here is a short cut,
otherwise the first thing a newcomer sees would prove nothing.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable

from inspection.demo.plant import DemoPlant
from inspection.models import Inspection, Rig, Scan, User
from inspection.services.queue import enqueue_inspection, resume_queue
from inspection.states import LIVE, QueueState, ScanState

#: A demo scan that shows no progress for this long will not come any more.
STALLED_S = 180.0


def order_demo_scan(plant: DemoPlant) -> Inspection:
    """Queue the demo knife's regions, as its operator would; a queue left paused by an earlier run is resumed."""
    operator = User.objects.filter(username="olga").first()
    rig = Rig.objects.get(pk=plant.rig.pk)
    if rig.queue_state == QueueState.PAUSED:
        resume_queue(rig, operator)
    return enqueue_inspection(tool=plant.tool, rig=rig, by=operator, reason="First scan after start-up")


def follow(
    inspection: Inspection,
    say: Callable[[str], None],
    *,
    tick: Callable[[], None] = lambda: None,
    wait: Callable[[float], None] = time.sleep,
    clock: Callable[[], float] = time.monotonic,
) -> list[Scan]:
    """Print each scan's progress until none of them can change any more, and return them in region order."""
    said: dict[int, str] = {}
    last_change = clock()
    while True:
        tick()
        scans = list(inspection.scans.select_related("region", "rig").order_by("region__name"))
        for scan in scans:
            line = progress(scan)
            if said.get(scan.pk) != line:
                said[scan.pk] = line
                last_change = clock()
                say(line)
        if not any(scan.state in LIVE for scan in scans):
            return scans
        if clock() - last_change > STALLED_S:
            rig = Rig.objects.get(pk=scans[0].rig_id)
            reason = f" The queue is {rig.queue_state}: {rig.queue_reason}" if rig.queue_reason else ""
            say(f"No progress for {STALLED_S:.0f} s; giving up.{reason}")
            return scans
        wait(0.25)


def progress(scan: Scan) -> str:
    """One line about a scan, coarse enough (tenths) to be printed only when something has changed."""
    name = scan.region.name
    if scan.state in {ScanState.RUNNING, ScanState.PAUSED} and scan.total:
        tenth = scan.done * 10 // scan.total
        bar = "#" * tenth + "." * (10 - tenth)
        return f"    {name}  {scan.phase or scan.state:<10} [{bar}]"
    if scan.fault:
        return f"    {name}  {scan.state}: {scan.fault}"
    return f"    {name}  {scan.state}"


HEADERS = (
    "region", "undefined %", "saturated %", "sigma um (cell um)", "missing mm3", "max depth um", "damages", "verdict",
    "seconds",
)  # fmt: skip


def table(scans: Iterable[Scan]) -> list[str]:
    """Return the measured table, one line a region, with expanded uncertainty (k = 2) where there is one."""
    rows = [HEADERS, *(row(scan) for scan in scans)]
    widths = [max(len(line[i]) for line in rows) for i in range(len(HEADERS))]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in rows]
    return [lines[0], "-" * len(lines[0]), *lines[1:]]


def row(scan: Scan) -> tuple[str, ...]:
    image = scan.range_images.select_related("precision").first()
    if image is None:
        return (scan.region.name, "-", "-", "-", "-", "-", "-", scan.state, "-")
    precision = image.precision
    found = {m.metric: m for m in image.measurements.all()}

    def number(metric: str, digits: int) -> str:
        m = found.get(metric)
        if m is None or m.value is None:
            return "-"
        return f"{m.value:.{digits}f}" + (f" +-{2 * m.u:.{digits}f}" if m.u is not None else "")

    sigma = "-" if precision.sigma_um is None else f"{precision.sigma_um:.2f}"
    seconds = (scan.finished_at - scan.started_at).total_seconds() if scan.finished_at and scan.started_at else None
    return (
        scan.region.name,
        f"{100 * precision.undefined_share:.2f}",
        f"{100 * precision.saturated_share:.3f}",
        f"{sigma} ({precision.cell_scan_um:.0f} x {precision.cell_row_um:.0f})",
        number("V-", 5),
        number("d_max", 1),
        str(image.damages.count()),
        image.verdict,
        "-" if seconds is None else f"{seconds:.1f}",
    )
