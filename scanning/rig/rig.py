"""A rig put together from its configuration: which stage, which laser, which camera.

The configuration is a plain dict, kept in the database and shown on a page, so a wrong key must come back as one
sentence and not as a traceback from some driver. New hardware is one line in `STAGES` or `CAMERAS`.

    {"name": "Rig 1",
     "stage": {"driver": "grbl", "port": "/dev/serial/by-id/...", "step_um": 0.49, "travel_mm": 100},
     "laser": {"power": 1.0, "warm_up_s": 0.2},
     "camera": {"driver": "simulated", "address": "/run/rig/camera.sock"}}
"""

from __future__ import annotations

import inspect
import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

from scanning.errors import BadInput
from scanning.rig.gentl import GenTLCamera
from scanning.rig.grbl import GrblLaser, GrblStage
from scanning.rig.protocols import Camera, Laser, Stage
from scanning.rig.pylon import PylonCamera
from scanning.rig.simulated.camera import SimulatedCamera

log = logging.getLogger(__name__)

Config = Mapping[str, Any]
Part = TypeVar("Part")


@dataclass(frozen=True)
class Rig:
    """Stage, laser and camera that stand around one tool. ``warm_up_s``: how long the laser needs to be steady."""

    stage: Stage
    laser: Laser
    camera: Camera
    name: str = "rig"
    warm_up_s: float = 0.0


def _grbl(options: Mapping[str, Any]) -> GrblStage:
    options = dict(options)
    if "settings" in options:
        options["settings"] = {int(str(key).lstrip("$")): float(value) for key, value in options["settings"].items()}
    port = options.pop("port")
    return GrblStage(port, **options)


#: Each driver with the callable whose parameters are the keys it accepts, and the one that makes it.
STAGES: dict[str, tuple[Callable[..., Stage], Callable[[Mapping[str, Any]], Stage]]] = {"grbl": (GrblStage, _grbl)}
CAMERAS: dict[str, tuple[Callable[..., Camera], Callable[[Mapping[str, Any]], Camera]]] = {
    "simulated": (SimulatedCamera, lambda options: SimulatedCamera(**options)),
    "pylon": (PylonCamera, lambda options: PylonCamera(**options)),
    "gentl": (GenTLCamera, lambda options: GenTLCamera(**options)),
}


def build_rig(config: Config) -> Rig:
    """Make the rig's parts without touching hardware. Raises `BadInput` for a configuration that cannot work."""
    name = str(config.get("name", "rig"))
    unknown = set(config) - {"name", "stage", "laser", "camera"}
    if unknown:
        raise BadInput(f"The configuration of {name} has an unknown part '{sorted(unknown)[0]}'; remove it.")
    stage = _make(name, "stage", config, STAGES)
    camera = _make(name, "camera", config, CAMERAS)
    laser_options = dict(config.get("laser") or {})
    warm_up_s = laser_options.pop("warm_up_s", 0.0)
    driver = laser_options.pop("driver", "grbl")
    if driver != "grbl" or not isinstance(stage, GrblStage):
        raise BadInput(f"The laser of {name} has driver '{driver}'; choose grbl (on the stage's controller).")
    if set(laser_options) - {"power"}:
        raise BadInput(f"The laser of {name} has an unknown setting '{sorted(set(laser_options) - {'power'})[0]}'.")
    laser = GrblLaser(stage, power=_number(name, "laser", "power", laser_options.get("power", 1.0)))
    return Rig(stage, laser, camera, name, _number(name, "laser", "warm_up_s", warm_up_s))


def _number(rig: str, part: str, key: str, value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError) as fault:
        raise BadInput(f"The {part} of {rig} has {key} = {value!r}; it must be a number.") from fault


def _make(
    rig: str,
    part: str,
    config: Config,
    drivers: Mapping[str, tuple[Callable[..., Part], Callable[[Mapping[str, Any]], Part]]],
) -> Part:
    options = config.get(part)
    if not isinstance(options, Mapping):
        raise BadInput(f"The configuration of {rig} has no {part}; add one.")
    options = dict(options)
    driver = options.pop("driver", None)
    if driver not in drivers:
        raise BadInput(f"The {part} of {rig} has driver {driver!r}; choose one of {', '.join(sorted(drivers))}.")
    accepts, make = drivers[driver]
    parameters = inspect.signature(accepts).parameters
    for key in options:
        if key not in parameters or key == "clock":
            raise BadInput(f"The {part} of {rig} has an unknown setting '{key}'; remove it.")
    for key, parameter in parameters.items():
        if parameter.default is parameter.empty and key not in options:
            raise BadInput(f"The {part} of {rig} lacks its setting '{key}'; add it.")
    try:
        return make(options)
    except (TypeError, ValueError, AttributeError) as fault:
        raise BadInput(f"The {part} of {rig} has a setting that cannot be used ({fault}); correct it.") from fault


@contextmanager
def open_rig(config: Config) -> Iterator[Rig]:
    """Open camera and stage, hand over the rig, and leave it dark and closed whatever happens inside.

    Raises `RigFault` with one sentence when a part cannot be opened. What was opened before it is closed again.
    """
    rig = build_rig(config)

    def attempt(what: str, do: Callable[[], None]) -> None:
        try:
            do()
        except Exception:  # the fault that brought us here is the one to show
            log.exception("%s of %s failed while leaving the rig", what, rig.name)

    # An ExitStack goes on with its next callback even when a signal interrupts one of them.
    with ExitStack() as leaving:
        leaving.callback(attempt, "closing the camera", rig.camera.close)
        # Also resets the controller, which darkens the laser even if `off` failed.
        leaving.callback(attempt, "closing the stage", rig.stage.close)
        leaving.callback(attempt, "switching off the laser", rig.laser.off)
        rig.camera.open()
        rig.stage.open()
        yield rig
