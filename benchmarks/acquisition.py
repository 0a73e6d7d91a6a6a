"""What software adds to a scan: each step against what its motion, its serial line and its exposures must take.

A stage step and an exposure take the time they take; everything else is ours. The simulated rig runs in a process of
its own at real speed with a picture that costs nothing to make, so what is measured is the driver, the loop and the two
connections, as on a real rig. The hardware's time is computed, not measured: a loop that waits for itself inside a call
to the stage would otherwise count as motion.
"""

from __future__ import annotations

import math
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from scanning.rig.protocols import Frame, SensorMode
from scanning.rig.rig import open_rig
from scanning.rig.session import AcquisitionSummary, Order, ScanPlan, acquire
from scanning.rig.simulated.bench import READOUT_BYTES_PER_US, READOUT_OVERHEAD_US, Bench, Optics, Part
from scanning.rig.simulated.settings import DEFAULT_SETTINGS

STEP_UM = 0.49
MODE = SensorMode(rows=1000, columns=256)
PLANS = {
    "one exposure of 2 ms": (2000.0,),
    "three exposures, 0.2 to 3.2 ms": (200.0, 800.0, 3200.0),
    "five exposures, 0.1 to 25.6 ms": (100.0, 400.0, 1600.0, 6400.0, 25600.0),
}
STEPS = 300
BYTE_S = 10 / 115200


class _Grey:
    """Light that costs nothing."""

    def __init__(self) -> None:
        self._field = np.zeros((MODE.rows, MODE.columns), np.float32)
        self._image = np.full((MODE.rows, MODE.columns), 17, np.uint8)

    def irradiance(self, position_um: float, laser_on: bool = True) -> np.ndarray:
        return self._field

    def expose(self, irradiance: np.ndarray, exposure_us: float, rng: np.random.Generator) -> np.ndarray:
        return self._image


class _Run:
    def read(self) -> Order:
        return "run"


def hardware_s(plan: ScanPlan) -> tuple[float, float, float]:
    """Seconds that one step must take: (motion, serial line, exposures with what the sensor makes them wait)."""
    distance_mm = plan.motor_steps * STEP_UM / 1000
    motion = 2 * math.sqrt(distance_mm / DEFAULT_SETTINGS[120])
    line = len("G1X12.3456\nG4P0\nok\r\nok\r\n") * BYTE_S
    readout = (READOUT_OVERHEAD_US + MODE.rows * MODE.columns / READOUT_BYTES_PER_US) * 1e-6
    first, *later = (exposure * 1e-6 for exposure in plan.exposures_us)
    return motion, line, first + sum(max(exposure, readout) for exposure in later)


def measure(plan: ScanPlan) -> AcquisitionSummary:
    with tempfile.TemporaryDirectory(prefix="rig") as folder:
        rig_process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.acquisition", "--serve", folder],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert rig_process.stdin is not None
        assert rig_process.stdout is not None
        rig_process.stdout.readline()
        config = {
            "name": "Rig",
            "stage": {"driver": "grbl", "port": f"{folder}/stage.tty", "travel_mm": 100.0},
            "camera": {"driver": "simulated", "address": f"{folder}/camera.sock"},
        }
        try:
            with open_rig(config) as rig:
                return acquire(rig, plan, on_frames=_keep_nothing, control=_Run())
        finally:
            rig_process.stdin.close()
            rig_process.wait(10)
            rig_process.stdout.close()


def _keep_nothing(step: int, frames: list[Frame]) -> None:
    pass


def serve(folder: str) -> None:
    lighting = lambda part, mode: Optics(_Grey(), 255, "linear")  # noqa: E731
    with Bench(Path(folder), speed_up=1.0, part=Part("grey", start_mm=0.0), lighting=lighting):
        print("ready", flush=True)
        sys.stdin.read()


def main(arguments: list[str]) -> int:
    """Print one Markdown table: milliseconds per step, best of three scans of `STEPS` steps."""
    if arguments[:1] == ["--serve"]:
        serve(arguments[1])
        return 0
    print("| bracket | motion | serial line | exposure | hardware | measured | software adds | by its own budget |")
    print("|---|---|---|---|---|---|---|---|")
    for name, exposures_us in PLANS.items():
        plan = ScanPlan(1.0, STEPS, exposures_us, MODE)
        motion, line, exposure = hardware_s(plan)
        runs = [measure(plan).time for _ in range(3)]
        steps = [
            (t.motion_s + t.settle_s + t.exposure_s + t.readout_s + t.sink_wait_s + t.software_s) / STEPS for t in runs
        ]
        best = min(range(3), key=lambda k: steps[k])
        hardware = motion + line + exposure
        print(
            f"| {name} | {motion * 1e3:.1f} | {line * 1e3:.1f} | {exposure * 1e3:.1f} | {hardware * 1e3:.1f} | "
            f"{steps[best] * 1e3:.1f} | {steps[best] / hardware - 1:.1%} | {runs[best].software_share:.1%} |"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
