"""The demo plant: a simulated rig, three knives with their regions, people, a calibration and a history.

Everything is made through the same services a person's clicks go through, and every number in it was measured: the
rig is calibrated by scanning the simulated step gauge, and the history holds range images of surfaces whose truth is
known. What was simulated says so in its origin.
"""

from __future__ import annotations

import datetime as dt
import hashlib
import secrets
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from django.conf import settings
from django.utils import timezone

from inspection.demo.gauge import gauge_pairs
from inspection.demo.history import RECESSION_UM_PER_HOUR, individual, make_history
from inspection.models import Calibration, Rig, Role, Scan, Schedule, Tool, ToolType, User
from inspection.services.calibrations import add_calibration
from inspection.services.plant import DEFAULT_REGIONS, create_tool, create_tool_type, record_event
from inspection.services.schedules import save_schedule

DEMO_RIG = "demo-rig"
DEMO_TOOL = "KN-07"
#: The paper's bracket E1, 19 dB.
E1_US = [100.0, 300.0, 500.0, 700.0, 900.0]
TRAVEL_MM = 100.0
PEOPLE = {"vera": Role.VIEWER, "olga": Role.OPERATOR, "erik": Role.ENGINEER, "adam": Role.ADMIN}

#: The demo knives: code, place, hours in use, what their regions look like at the last visit.
KNIVES: dict[str, tuple[str, float]] = {
    DEMO_TOOL: ("Chipper 1, pocket 7", 42.0),
    "KN-08": ("Chipper 1, pocket 8", 18.0),
    "KN-12": ("Tool room, shelf 2", 0.0),
}


@dataclass
class DemoPlant:
    rig: Rig
    tool: Tool
    passwords: dict[str, tuple[str, str]] = field(default_factory=dict)


def machine_folder() -> Path:
    """Where the simulated machine keeps its port and socket: short, because a socket's path must be."""
    return Path(tempfile.gettempdir()) / f"edgewatch-rig-{hashlib.sha256(str(settings.HOME).encode()).hexdigest()[:10]}"


def rig_config(speed_up: float) -> dict[str, Any]:
    folder = machine_folder()
    return {
        "system": "IS1",
        "stage": {"driver": "grbl", "port": str(folder / "stage.tty"), "step_um": 0.49, "travel_mm": TRAVEL_MM},
        "laser": {"power": 1.0},
        "camera": {"driver": "simulated", "address": str(folder / "camera.sock")},
        "sensor": {"columns": 256},
        "simulated": {"dir": str(folder), "speed_up": speed_up, "parts": demo_parts()},
    }


def demo_parts() -> dict[str, Any]:
    """What lies on the simulated rig when a demo knife is scanned: worn as its hours say; only KN-07 is damaged."""
    parts: dict[str, Any] = {}
    for code, (_, hours) in KNIVES.items():
        worn = {"wear_um": RECESSION_UM_PER_HOUR * hours}
        if code == DEMO_TOOL:
            parts[code] = dict.fromkeys(DEFAULT_REGIONS, worn)
        else:
            parts[code] = {
                region: {**worn, "scene": "R1", "seed": individual(code) + number}
                for number, region in enumerate(DEFAULT_REGIONS)
            }
    return parts


def make_demo_plant(say: Callable[[str], None], *, speed_up: float = 20.0) -> DemoPlant:
    """Make what is not there yet and return the plant. A second call changes nothing but the rig's speed-up.

    The knives' earlier visits take a minute of computing and are left to `make_histories`.
    """
    passwords = make_people()
    engineer = User.objects.filter(username="erik").first()
    rig, fresh = Rig.objects.get_or_create(
        slug=DEMO_RIG,
        defaults={
            "name": "Demo rig (simulated)",
            "config": rig_config(speed_up),
            "travel_mm": TRAVEL_MM,
            "exposures_us": E1_US,
        },
    )
    if not fresh and rig.config.get("simulated"):
        rig.config = {**rig.config, **{k: v for k, v in rig_config(speed_up).items() if k in ("stage", "camera")}}
        rig.config["simulated"] = {**rig.config["simulated"], "dir": str(machine_folder()), "speed_up": speed_up}
        rig.save(update_fields=["config"])
    if not rig.calibrations.exists():
        say("Calibrating the demo rig on its simulated step gauge ...")
        calibrate(rig, engineer)
    tool = make_knives(rig, engineer)
    return DemoPlant(rig, tool, passwords)


def make_people() -> dict[str, tuple[str, str]]:
    """Add the four demo people; return the passwords of those just made, which are kept nowhere in the clear."""
    if User.objects.exists():
        return {}
    made = {}
    for name, role in PEOPLE.items():
        password = secrets.token_urlsafe(9)
        User.objects.create_user(name, password=password, role=role, first_name=name.capitalize())
        made[name] = (str(role), password)
    return made


def calibrate(rig: Rig, by: User | None) -> Calibration:
    today = timezone.localdate()
    return add_calibration(
        rig=rig,
        csv_file=gauge_pairs(),
        by=by,
        artefact="Simulated step gauge, 0.14 to 0.745 mm (the paper's Table 2)",
        done_on=today,
        valid_until=today + dt.timedelta(days=180),
        note="Fitted to a scan of the simulated gauge; no real gauge was involved.",
    )


def make_histories(say: Callable[[str], None]) -> None:
    """Add the earlier visits of the demo knives that were used and have none."""
    rig = Rig.objects.get(slug=DEMO_RIG)
    engineer = User.objects.filter(username="erik").first()
    for code, (_, hours) in KNIVES.items():
        tool = Tool.objects.get(code=code)
        if hours and not Scan.objects.filter(region__tool=tool, source=Scan.Source.IMPORT).exists():
            installed = tool.events.filter(kind="installed").earliest("at").at
            make_history(tool, rig, hours=hours, since=installed, by=engineer, say=say)


def make_knives(rig: Rig, by: User | None) -> Tool:
    kind = ToolType.objects.filter(name="Chipping knife 55°").first()
    if kind is None:
        kind = create_tool_type(by=by, name="Chipping knife 55°", edge_length_mm=60.0, bevel_angle_deg=55.0)
    today = timezone.localdate()
    for number, (code, (location, hours)) in enumerate(KNIVES.items()):
        if Tool.objects.filter(code=code).exists():
            continue
        tool = create_tool(by=by, code=code, tool_type=kind, location=location, life_used=hours)
        if number == 2:
            tool.status = Tool.Status.SPARE
            tool.save(update_fields=["status"])
        installed = timezone.now() - dt.timedelta(days=30)
        record_event(tool=tool, kind="installed", at=installed, by=by, note="Ground edge, new in the pocket.")
        if number < 2:
            save_schedule(
                by=by, tool=tool, rig=rig, every=1, unit=Schedule.Unit.WEEKS,
                next_due=today + dt.timedelta(days=7 if number == 0 else 2),
            )  # fmt: skip
    return Tool.objects.get(code=DEMO_TOOL)
