"""Driver, controller, camera and loop together over a real serial port and a real socket.

The bench's light writes stage position and laser state into the picture, so each frame proves where it was taken.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from scanning.errors import BadInput, CameraFault, RigFault, StageFault, Stopped
from scanning.rig.protocols import Frame
from scanning.rig.rig import Rig, open_rig
from scanning.rig.session import Order, ScanPlan, acquire
from scanning.rig.simulated.bench import Bench
from scanning.rig.simulated.camera import SimulatedCamera
from tests.scanning.rig.conftest import MODE, laser_of, wait_until

START = round(10_000 / 0.49)
PLAN = ScanPlan(start_mm=10.0, steps=12, exposures_us=(50.0, 150.0, 450.0), mode=MODE, frame_timeout_s=1.0)


def config(bench: Bench) -> dict[str, Any]:
    return {
        "name": "Rig 1",
        "stage": {"driver": "grbl", "port": bench.port, "travel_mm": 100},
        "camera": {"driver": "simulated", "address": bench.camera_address},
    }


class Always:
    def __init__(self, order: Order = "run") -> None:
        self.order = order

    def read(self) -> Order:
        return self.order


class Kept:
    """Collects (step, [(position in motor steps, laser, exposure) ...])."""

    def __init__(self) -> None:
        self.steps: dict[int, list[tuple[int, int, int]]] = {}

    def __call__(self, step: int, frames: list[Frame]) -> None:
        self.steps[step] = [tuple(int(v) for v in f.image[0, :3]) for f in frames]  # type: ignore[misc]


def expected(steps: range) -> dict[int, list[tuple[int, int, int]]]:
    return {k: [(START + 17 * k, 1, e) for e in (50, 150, 450)] for k in steps}


def test_every_frame_is_taken_at_its_exact_place_with_the_laser_on(bench: Bench) -> None:
    kept = Kept()
    with open_rig(config(bench)) as rig:
        summary = acquire(rig, PLAN, on_frames=kept, control=Always())
    assert kept.steps == expected(range(12))
    assert summary.link.bad_lines == summary.link.retries == 0
    assert laser_of(bench) == 0.0
    assert bench.state()["position_um"] == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize("fault", ["silent", "incomplete", "wrong_size", "stuck", "hang_up"])
def test_one_bad_frame_is_taken_again_at_the_same_place(bench: Bench, fault: str) -> None:
    kept = Kept()
    with open_rig(config(bench)) as rig:

        def spoil(step: int, frames: list[Frame]) -> None:
            kept(step, frames)
            if step == 4:
                bench.provoke("camera", fault)

        summary = acquire(rig, replace(PLAN, frame_timeout_s=0.3), on_frames=spoil, control=Always())
    assert summary.retaken_frames == 1
    assert kept.steps == expected(range(12))
    assert laser_of(bench) == 0.0


@pytest.mark.parametrize(
    ("fault", "sentence"),
    [
        ("silent", r"sent nothing within .* check its supply, cable and trigger"),
        ("incomplete", r"incomplete frame \(21 of 64 bytes\); check the camera's cable"),
        ("wrong_size", r"4x7 pixels instead of 4x8"),
        ("stuck", r"stuck"),
        ("hang_up", r"connection to the camera .* broke"),
    ],
)
def test_a_camera_that_keeps_failing_ends_the_scan_dark_and_parked(bench: Bench, fault: str, sentence: str) -> None:
    def spoil(step: int, frames: list[Frame]) -> None:
        bench.provoke("camera", fault, count=1000)

    with open_rig(config(bench)) as rig, pytest.raises(CameraFault, match=sentence):
        acquire(rig, replace(PLAN, frame_timeout_s=0.2), on_frames=spoil, control=Always())
    assert laser_of(bench) == 0.0
    assert bench.state()["position_um"] == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize("fault", ["unplug", "reset", "alarm"])
def test_a_stage_that_fails_in_a_move_ends_the_scan_dark(bench: Bench, fault: str) -> None:
    kept = Kept()

    def spoil(step: int, frames: list[Frame]) -> None:
        kept(step, frames)
        if step == 5:
            bench.provoke("stage", fault, in_move=True)

    with open_rig(config(bench)) as rig, pytest.raises(StageFault, match=r"check|free"):
        acquire(rig, replace(PLAN, steps=60), on_frames=spoil, control=Always())
    assert laser_of(bench) == 0.0
    assert kept.steps == expected(range(len(kept.steps)))
    assert 6 <= len(kept.steps) < 60


def test_pause_on_real_hardware_rehomes_and_goes_on_exactly(bench: Bench) -> None:
    kept, paused = Kept(), []

    class PauseOnce:
        def __init__(self) -> None:
            self.readings = 0

        def read(self) -> Order:
            self.readings += 1
            if self.readings == 6:
                return "pause"
            if self.readings == 7:
                paused.append((laser_of(bench), bench.state()["position_um"]))
            return "run"

    with open_rig(config(bench)) as rig:
        summary = acquire(rig, PLAN, on_frames=kept, control=PauseOnce())
    assert paused == [(0.0, pytest.approx(0.0, abs=0.01))]
    assert summary.pauses == 1
    assert kept.steps == expected(range(12))


def test_a_stage_without_home_switch_pauses_and_goes_on_too(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench(settings={20: 0.0, 21: 0.0, 22: 0.0})
    kept, zero = Kept(), round(bench.state()["position_um"] / 0.49)

    class PauseOnce:
        readings = 0

        def read(self) -> Order:
            self.readings += 1
            return "pause" if self.readings == 6 else "run"

    here = config(bench)
    here["stage"]["zero"] = "here"
    with open_rig(here) as rig:
        assert acquire(rig, PLAN, on_frames=kept, control=PauseOnce()).pauses == 1
    assert kept.steps == {k: [(zero + p, on, e) for p, on, e in bracket] for k, bracket in expected(range(12)).items()}


def test_cancel_and_emergency_stop(bench: Bench) -> None:
    with open_rig(config(bench)) as rig:
        with pytest.raises(Stopped):
            acquire(rig, PLAN, on_frames=Kept(), control=Always("cancel"))
        assert bench.state()["position_um"] == pytest.approx(0.0, abs=0.01)

        def press(step: int, frames: list[Frame]) -> None:
            if step == 3:
                threading.Thread(target=rig.stage.emergency_stop).start()

        with pytest.raises(StageFault, match="Emergency stop"):
            acquire(rig, replace(PLAN, steps=500), on_frames=press, control=Always())
        assert laser_of(bench) == 0.0


def test_a_frame_during_motion_is_smeared_over_the_way(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench(speed_up=20.0)
    with open_rig(config(bench)) as rig:
        rig.camera.configure(MODE)
        rig.stage.home()
        mover = threading.Thread(target=rig.stage.move_to, args=(100_000,))
        mover.start()
        assert wait_until(lambda: bool(bench.state()["moving"]))
        rig.camera.grab(50_000.0, timeout_s=2.0)
        mover.join()
    assert bench._field is not None
    assert len(bench._field[1]) == 3


def test_a_camera_that_is_not_there_and_a_stage_that_is_not_there(bench: Bench) -> None:
    for part, key in (("camera", "address"), ("stage", "port")):
        broken = config(bench)
        broken[part] = {**broken[part], key: "/nowhere/at/all"}
        with pytest.raises(RigFault, match=r"/nowhere/at/all"), open_rig(broken):
            pass
    with open_rig(config(bench)):  # nothing was left open by the failures
        pass


def test_the_rig_is_dark_and_closed_when_the_body_raises(bench: Bench) -> None:
    def lose_it(rig: Rig) -> None:
        rig.stage.home()
        rig.laser.on()
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError), open_rig(config(bench)) as rig:
        lose_it(rig)
    assert laser_of(bench) == 0.0
    with open_rig(config(bench)):
        pass


def test_a_part_is_laid_on_the_rig_by_command(bench: Bench) -> None:
    camera = SimulatedCamera(bench.camera_address)
    camera.load_part("R2", seed=7, wear_um=120.0, start_mm=20.0)
    state = camera.bench_state()
    assert (state["scene"], state["seed"], state["wear_um"]) == ("R2", 7, 120.0)
    with pytest.raises(CameraFault, match="does not know"):
        camera._ask({"do": "dance"})
    with pytest.raises(CameraFault, match="configure it before exposing"):
        camera.expose(100.0, timeout_s=1.0)
    camera.close()


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"stage": None}, "has no stage; add one"),
        ({"stage": {"driver": "gcode", "port": "x"}}, "driver 'gcode'; choose one of grbl"),
        ({"stage": {"driver": "grbl"}}, "lacks its setting 'port'"),
        ({"stage": {"driver": "grbl", "port": "x", "sped": 1}}, "unknown setting 'sped'"),
        ({"stage": {"driver": "grbl", "port": "x", "settings": {"a": 1}}}, "setting that cannot be used"),
        ({"stage": {"driver": "grbl", "port": "x", "step_um": -1}}, "positive length"),
        ({"camera": {"driver": "simulated"}}, "lacks its setting 'address'"),
        ({"laser": {"driver": "lamp"}}, "driver 'lamp'"),
        ({"laser": {"power": "full"}}, "power = 'full'; it must be a number"),
        ({"laser": {"color": "red"}}, "unknown setting 'color'"),
        ({"lazer": {}}, "unknown part 'lazer'"),
    ],
)
def test_a_configuration_that_cannot_work_is_one_sentence(bench: Bench, change: dict[str, Any], sentence: str) -> None:
    with pytest.raises(BadInput, match=sentence), open_rig(config(bench) | change):
        pass
