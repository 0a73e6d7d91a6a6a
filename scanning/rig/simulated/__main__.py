"""Run a simulated rig: ``python -m scanning.rig.simulated --dir DIR [--speed-up X] [--scene R2 ...]``.

Makes DIR/stage.tty and DIR/camera.sock, says so in one line, and runs until it is terminated or, with
``--with-parent``, until the process that started it is gone."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
from pathlib import Path

from scanning.errors import Fault
from scanning.rig.simulated.bench import Bench, Part


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m scanning.rig.simulated", description="Run a simulated scanning rig."
    )
    parser.add_argument("--dir", type=Path, required=True, help="where stage.tty and camera.sock are made")
    parser.add_argument("--speed-up", type=float, default=1.0, help="how much faster than real time the rig moves")
    parser.add_argument("--scene", default="R1", help="what lies on the rig: R1, R2, R3, gauge, flat")
    parser.add_argument("--seed", type=int, default=1, help="which part")
    parser.add_argument("--wear-um", type=float, default=0.0, help="how worn it is")
    parser.add_argument("--start-mm", type=float, default=10.0, help="stage position where the region begins")
    parser.add_argument("--with-parent", action="store_true", help="end when the starting process ends")
    options = parser.parse_args(arguments)
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    parent = os.getppid()
    try:
        part = Part(options.scene, options.seed, options.wear_um, options.start_mm)
        with Bench(options.dir.resolve(), speed_up=options.speed_up, part=part) as bench:
            print(f"Simulated rig ready: stage on {bench.port}, camera at {bench.camera_address}.", flush=True)
            while not stop.wait(1.0 if options.with_parent else None):
                if os.getppid() != parent:
                    break
    except Fault as fault:
        print(fault, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
