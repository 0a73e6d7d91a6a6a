"""The acquisition loop against fakes that record every call: order, overlap, orders of a person, and safety.

The heart is `test_whatever_raises_wherever`: a fault injected at every single hardware call of a scan.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from scanning.errors import BadInput, CameraFault, RigFault, StageFault, Stopped
from scanning.rig.protocols import Frame, LinkQuality, SensorMode
from scanning.rig.rig import Rig
from scanning.rig.session import AcquisitionSummary, Order, ScanPlan, acquire

MODE = SensorMode(rows=4, columns=8)
PLAN = ScanPlan(start_mm=1.0, steps=6, exposures_us=(100.0, 300.0), mode=MODE)
START = round(1000 / 0.49)


class FakeClock:
    def __init__(self) -> None:
        self.now = 0.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


@dataclass
class Tape:
    """Every call in order; ``fail_at`` is the number of the call that raises."""

    calls: list[str] = field(default_factory=list)
    fail_at: int | None = None
    fault: BaseException = field(default_factory=lambda: StageFault("the stage broke"))

    def note(self, call: str) -> None:
        self.calls.append(call)
        if self.fail_at is not None and len(self.calls) == self.fail_at:
            raise self.fault


class FakeStage:
    step_um = 0.49
    travel_mm = 100.0

    def __init__(self, tape: Tape, clock: FakeClock) -> None:
        self.tape, self.clock = tape, clock
        self.at: int | None = None
        self.visited: list[int] = []

    def open(self) -> None: ...
    def close(self) -> None: ...

    def home(self) -> None:
        self.at = None
        self.tape.note("home")
        self.at = 0

    def move_to(self, steps: int) -> None:
        self.tape.note(f"move {steps}")
        self.clock.now += 0.02
        self.at = steps
        self.visited.append(steps)

    @property
    def position_steps(self) -> int:
        if self.at is None:
            raise StageFault("The stage does not know where it is; home it first.")
        return self.at

    def park(self) -> None:
        self.tape.note("park")
        self.at = 0

    def emergency_stop(self) -> None:
        self.tape.note("emergency stop")

    def link_quality(self) -> LinkQuality:
        return LinkQuality(lines_sent=7)


class OverlapStage(FakeStage):
    """Lets the frames be read out on its way."""

    def move_to_while(self, steps: int, meanwhile: Callable[[], None]) -> None:
        self.tape.note(f"set out to {steps}")
        meanwhile()
        self.move_to(steps)


class FakeLaser:
    def __init__(self, tape: Tape) -> None:
        self.tape, self.lit = tape, False

    def on(self) -> None:
        self.lit = True
        self.tape.note("laser on")

    def off(self) -> None:
        self.tape.note("laser off")
        self.lit = False


class FakeCamera:
    """A plain camera; `OverlapCamera` below can expose and read out apart."""

    saturation = 255

    def __init__(self, tape: Tape, stage: FakeStage, laser: FakeLaser) -> None:
        self.tape, self.stage, self.laser = tape, stage, laser
        self.frame_id = 0
        self.spoil: dict[int, dict[str, Any]] = {}

    def open(self) -> None: ...
    def close(self) -> None: ...

    def configure(self, mode: SensorMode) -> None:
        self.tape.note("configure")

    def _take(self, exposure_us: float) -> Frame:
        self.frame_id += 1
        self.stage.clock.now += exposure_us * 1e-6
        image = np.full((MODE.rows, MODE.columns), 100 if self.laser.lit else 3, np.uint8)
        frame = Frame(image, exposure_us, self.frame_id, self.stage.clock.now)
        return replace(frame, **self.spoil.get(self.frame_id, {}))

    def grab(self, exposure_us: float, *, timeout_s: float) -> Frame:
        self.tape.note(f"grab {exposure_us:g}")
        return self._take(exposure_us)


class OverlapCamera(FakeCamera):
    def __init__(self, *parts: Any) -> None:
        super().__init__(*parts)
        self.held: list[Frame] = []

    def configure(self, mode: SensorMode) -> None:
        super().configure(mode)
        self.held = []

    def expose(self, exposure_us: float, *, timeout_s: float) -> None:
        self.tape.note(f"expose {exposure_us:g}")
        self.held.append(self._take(exposure_us))

    def read_out(self, *, timeout_s: float) -> Frame:
        self.tape.note("read out")
        return self.held.pop(0)


class Orders:
    """Says ``run`` except at the readings named."""

    def __init__(self, **at: Order) -> None:
        self._at = {int(key.removeprefix("at")): order for key, order in at.items()}
        self.readings = 0

    def read(self) -> Order:
        self.readings += 1
        return self._at.get(self.readings, "run")


class Bed:
    def __init__(
        self, camera: type[FakeCamera] = OverlapCamera, stage: type[FakeStage] = FakeStage, **tape: Any
    ) -> None:
        self.tape, self.clock = Tape(**tape), FakeClock()
        self.stage = stage(self.tape, self.clock)
        self.laser = FakeLaser(self.tape)
        self.camera = camera(self.tape, self.stage, self.laser)
        self.rig = Rig(self.stage, self.laser, self.camera, "Rig 1", warm_up_s=0.2)
        self.got: list[tuple[int, list[Frame]]] = []

    def keep(self, step: int, frames: list[Frame]) -> None:
        self.got.append((step, frames))

    def scan(self, plan: ScanPlan = PLAN, control: Orders | None = None, on_frames: Any = None) -> AcquisitionSummary:
        return acquire(self.rig, plan, on_frames=on_frames or self.keep, control=control or Orders(), clock=self.clock)

    def assert_safe(self) -> None:
        assert not self.laser.lit
        assert self.stage.at in (0, None)
        assert not [t for t in threading.enumerate() if t.name == "frame-sink" and t.is_alive()]


#: Camera and stage that can or cannot let one thing happen beside another.
ABILITIES = [
    (FakeCamera, FakeStage),
    (OverlapCamera, FakeStage),
    (FakeCamera, OverlapStage),
    (OverlapCamera, OverlapStage),
]


@pytest.fixture(params=ABILITIES, ids=["plain", "camera overlaps", "stage overlaps", "both overlap"])
def bed(request: pytest.FixtureRequest) -> Bed:
    return Bed(*request.param)


def test_a_scan_hands_on_every_step_with_its_bracket_in_order(bed: Bed) -> None:
    summary = bed.scan()
    assert [step for step, _ in bed.got] == list(range(6))
    assert all([f.exposure_us for f in frames] == [100.0, 300.0] for _, frames in bed.got)
    assert all(frame.image.max() == 100 for _, frames in bed.got for frame in frames)
    assert summary.steps_done == 6
    assert not summary.finished_early
    assert summary.dark_level == 3.0
    assert summary.link.lines_sent == 7
    bed.assert_safe()


def test_scan_positions_are_exact_and_approached_from_below(bed: Bed) -> None:
    bed.scan()
    assert bed.stage.visited == [START - 204, *(START + 17 * k for k in range(6))]


def test_the_laser_is_lit_after_homing_and_the_first_frame_is_taken_before_anything_moves(bed: Bed) -> None:
    bed.scan()
    calls = bed.tape.calls
    assert calls[:5] == ["configure", "laser off", "grab 100", "home", f"move {START - 204}"]
    assert calls[5] == "laser on"
    assert calls[-2:] == ["laser off", "park"]


def test_the_stage_moves_on_before_the_frames_are_read_out() -> None:
    bed = Bed(OverlapCamera)
    bed.scan(replace(PLAN, steps=2))
    at = bed.tape.calls.index(f"move {START}")
    assert bed.tape.calls[at:-2] == [
        f"move {START}", "expose 100", "expose 300",
        f"move {START + 17}", "read out", "read out", "expose 100", "expose 300", "read out", "read out",
    ]  # fmt: skip


def test_frames_are_read_out_while_the_stage_is_on_its_way() -> None:
    bed = Bed(OverlapCamera, OverlapStage)
    bed.scan(replace(PLAN, steps=2))
    at = bed.tape.calls.index(f"set out to {START}")
    assert bed.tape.calls[at:-2] == [
        f"set out to {START}", f"move {START}", "expose 100", "expose 300",
        f"set out to {START + 17}", "read out", "read out", f"move {START + 17}", "expose 100", "expose 300",
        "read out", "read out",
    ]  # fmt: skip


@pytest.mark.parametrize(("camera", "stage"), ABILITIES)
def test_a_step_that_was_exposed_whole_is_kept_when_the_next_move_fails(
    camera: type[FakeCamera], stage: type[FakeStage]
) -> None:
    calls = Bed(camera, stage)
    calls.scan()
    number = calls.tape.calls.index(f"move {START + 17 * 3}") + 1
    bed = Bed(camera, stage, fail_at=number)
    with pytest.raises(StageFault, match="the stage broke"):
        bed.scan()
    assert [step for step, _ in bed.got] == [0, 1, 2]
    assert all([f.exposure_us for f in frames] == [100.0, 300.0] for _, frames in bed.got)
    assert all(frame.image.max() == 100 for _, frames in bed.got for frame in frames)
    bed.assert_safe()


def test_frames_taken_at_the_wrong_place_are_not_kept() -> None:
    calls = Bed(OverlapCamera, OverlapStage)
    calls.scan()
    number = calls.tape.calls.index(f"set out to {START + 17 * 3}") + 1
    fault = StageFault("The stage stands elsewhere.")
    bed = Bed(OverlapCamera, OverlapStage, fail_at=number, fault=fault)  # what the check before setting out raises
    with pytest.raises(StageFault, match="stands elsewhere"):
        bed.scan()
    assert [step for step, _ in bed.got] == [0, 1]
    bed.assert_safe()


@pytest.mark.parametrize("stage", [FakeStage, OverlapStage])
def test_time_is_accounted_for(stage: type[FakeStage]) -> None:
    bed = Bed(OverlapCamera, stage)
    time = bed.scan(replace(PLAN, settle_s=0.005)).time
    assert time.motion_s == pytest.approx(6 * 0.02)
    assert time.settle_s == pytest.approx(6 * 0.005)
    assert time.exposure_s == pytest.approx(6 * 400e-6)
    assert time.homing_s == pytest.approx(0.02 + 0.2)
    assert time.wall_s == pytest.approx(6 * 0.02 + 6 * 0.005 + 6 * 400e-6 + 0.22 + 100e-6)
    assert time.software_s == pytest.approx(0.0, abs=1e-9)


# ---- orders of a person -----------------------------------------------------------------------------------------


def test_cancel_parks_and_keeps_the_frames(bed: Bed) -> None:
    with pytest.raises(Stopped, match="stopped at step 3 of 6"):
        bed.scan(control=Orders(at4="cancel"))
    assert [step for step, _ in bed.got] == [0, 1, 2]
    bed.assert_safe()


def test_finish_early_is_a_good_end(bed: Bed) -> None:
    summary = bed.scan(control=Orders(at4="finish"))
    assert summary.finished_early
    assert summary.steps_done == 3
    assert len(bed.got) == 3
    bed.assert_safe()


def test_pause_goes_dark_and_parks_then_rehomes_and_continues_at_the_exact_step(bed: Bed) -> None:
    summary = bed.scan(control=Orders(at3="pause", at4="pause", at5="pause"))
    calls = [call for call in bed.tape.calls if not call.startswith("set out")]
    at = calls.index("park")
    assert calls[at - 1] == "laser off"
    assert calls[at + 1 : at + 4] == ["home", f"move {START + 2 * 17 - 204}", "laser on"]
    assert calls[at + 4] == f"move {START + 2 * 17}"
    assert [step for step, _ in bed.got] == list(range(6))
    assert summary.pauses == 1
    assert summary.time.paused_s == pytest.approx(0.5)
    bed.assert_safe()


@pytest.mark.parametrize(("order", "ending"), [("cancel", "stopped"), ("finish", "")])
def test_a_paused_scan_can_be_ended(bed: Bed, order: Order, ending: str) -> None:
    control = Orders(at3="pause", at4=order)
    if ending:
        with pytest.raises(Stopped, match=ending):
            bed.scan(control=control)
    else:
        assert bed.scan(control=control).finished_early
    assert bed.tape.calls.count("laser on") == 1
    bed.assert_safe()


def test_it_continues_where_an_interrupted_scan_ended(bed: Bed) -> None:
    summary = bed.scan(replace(PLAN, first_step=4))
    assert [step for step, _ in bed.got] == [4, 5]
    assert summary.steps_done == 6
    assert bed.stage.visited[1:] == [START + 4 * 17, START + 5 * 17]


# ---- safety -----------------------------------------------------------------------------------------------------


def calls_of_a_whole_scan(camera: type[FakeCamera], stage: type[FakeStage]) -> list[str]:
    bed = Bed(camera, stage)
    bed.scan(replace(PLAN, steps=3), control=Orders(at2="pause", at3="run"))
    return bed.tape.calls


FAULTS: list[BaseException] = [
    StageFault("stage"), CameraFault("camera"), ValueError("bug"), KeyboardInterrupt(), SystemExit(143),
]  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: type(fault).__name__)
@pytest.mark.parametrize(("camera", "stage"), ABILITIES)
def test_whatever_raises_wherever(camera: type[FakeCamera], stage: type[FakeStage], fault: BaseException) -> None:
    """One fault at each call of a scan with a pause in it, cleanup included: always dark, and parked if it can be."""
    expected = calls_of_a_whole_scan(camera, stage)
    for number, call in enumerate(expected, start=1):
        bed = Bed(camera, stage, fail_at=number, fault=fault)
        in_bracket = call.split()[0] in ("expose", "read") or (call.startswith("grab") and number > 3)
        retaken = isinstance(fault, CameraFault) and in_bracket
        if retaken:
            assert bed.scan(replace(PLAN, steps=3), control=Orders(at2="pause", at3="run")).retaken_frames == 1
        else:
            with pytest.raises(type(fault)):
                bed.scan(replace(PLAN, steps=3), control=Orders(at2="pause", at3="run"))
        after = bed.tape.calls[number:]
        last_off = number == len(expected) - 1 and not isinstance(fault, KeyboardInterrupt | SystemExit)
        if last_off:  # switching off itself failed: the other way to the same end is taken
            assert "emergency stop" in after
        else:
            assert not bed.laser.lit, (number, call)
        assert "park" in bed.tape.calls[number - 1 :] or bed.stage.at is None, (number, call)
        assert not [t for t in threading.enumerate() if t.name == "frame-sink"]


def test_a_laser_that_cannot_be_switched_off_does_not_keep_the_stage_from_parking() -> None:
    bed = Bed(OverlapCamera)

    def broken() -> None:
        bed.tape.note("laser off")
        if "laser on" in bed.tape.calls:
            raise StageFault("no answer")

    bed.laser.off = broken  # type: ignore[method-assign]
    with pytest.raises(StageFault, match="no answer"):
        bed.scan()
    assert bed.tape.calls[-3:] == ["laser off", "emergency stop", "park"]


def test_the_first_fault_is_the_one_shown_and_later_ones_are_noted() -> None:
    bed = Bed(OverlapCamera, fail_at=12, fault=StageFault("first"))

    def park() -> None:
        raise StageFault("second")

    bed.stage.park = park  # type: ignore[method-assign]
    with pytest.raises(StageFault, match="first") as caught:
        bed.scan()
    assert any("park the stage: second" in note for note in caught.value.__notes__)


# ---- the sink ---------------------------------------------------------------------------------------------------


def test_an_error_of_the_sink_ends_the_scan_and_comes_out(bed: Bed) -> None:
    def full(step: int, frames: list[Frame]) -> None:
        if step == 2:
            raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space left"):
        bed.scan(replace(PLAN, steps=100), on_frames=full)
    assert len(bed.stage.visited) < 20
    bed.assert_safe()


def test_an_error_of_the_sink_on_the_last_step_is_not_lost(bed: Bed) -> None:
    def full(step: int, frames: list[Frame]) -> None:
        if step == 5:
            raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space left"):
        bed.scan(on_frames=full)
    bed.assert_safe()


def test_a_slow_sink_holds_the_scan_back_instead_of_filling_the_memory(bed: Bed) -> None:
    gate, done = threading.Event(), []

    def slow(step: int, frames: list[Frame]) -> None:
        gate.wait(5.0)
        done.append(step)

    most: list[int] = []
    note = bed.tape.note

    def watch(call: str) -> None:
        note(call)
        ahead = len(bed.stage.visited) - len(done)
        most.append(ahead)
        if ahead >= 6:
            gate.set()

    bed.tape.note = watch  # type: ignore[method-assign]
    bed.scan(replace(PLAN, steps=30), on_frames=slow)
    assert done == list(range(30))
    assert max(most) <= 9  # four queued, one in the sink, one in the camera, one under way, the approach


# ---- refusals ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("plan", "sentence"),
    [
        (replace(PLAN, start_mm=99.97), "lies at 99.97 to 100.01 mm but the stage of Rig 1 travels from 0 to 100 mm"),
        (replace(PLAN, start_mm=-0.1), "move the region"),
        (replace(PLAN, start_mm=float("nan")), "move the region"),
        (replace(PLAN, steps=0), "at least one step"),
        (replace(PLAN, first_step=6), "begin inside itself"),
        (replace(PLAN, exposures_us=()), "at least one exposure"),
        (replace(PLAN, exposures_us=(300.0, 100.0)), "must ascend"),
        (replace(PLAN, exposures_us=(float("nan"),)), "at least one exposure"),
        (replace(PLAN, mode=SensorMode(rows=0, columns=8)), "holds nothing"),
        (replace(PLAN, settle_s=-1.0), "not negative"),
    ],
)
def test_a_plan_that_cannot_be_carried_out_is_refused_before_anything_happens(plan: ScanPlan, sentence: str) -> None:
    bed = Bed()
    with pytest.raises(BadInput, match=sentence):
        bed.scan(plan)
    assert bed.tape.calls == []


@pytest.mark.parametrize(
    ("spoiled", "sentence"),
    [
        ({"image": np.zeros((4, 7), np.uint8)}, "4x7 pixels instead of 4x8; check the camera's region of interest"),
        ({"image": np.zeros((4, 8), np.uint16)}, "uint16 instead of 8 bits"),
        ({"frame_id": 1}, "camera is stuck: it sent frame 1 after frame"),
        ({"exposure_us": 77.0}, "exposed for 77 us instead of"),
    ],
)
def test_frames_that_cannot_be_trusted_are_taken_again_once_then_end_the_scan(
    bed: Bed, spoiled: dict[str, Any], sentence: str
) -> None:
    bed.camera.spoil = {5: spoiled}
    summary = bed.scan()
    assert summary.retaken_frames == 1
    assert [step for step, _ in bed.got] == list(range(6))
    assert all([f.exposure_us for f in frames] == [100.0, 300.0] for _, frames in bed.got)
    bed.camera.spoil = dict.fromkeys(range(bed.camera.frame_id + 5, 100), spoiled)
    with pytest.raises(RigFault, match=sentence):
        bed.scan()
    bed.assert_safe()


def test_a_dead_camera_is_found_before_the_stage_moves(bed: Bed) -> None:
    def dead(exposure_us: float, *, timeout_s: float) -> Frame:
        raise CameraFault("The camera sent nothing within 5 s; check its supply, cable and trigger.")

    bed.camera.grab = dead  # type: ignore[method-assign]
    with pytest.raises(CameraFault, match="sent nothing"):
        bed.scan()
    assert "home" not in bed.tape.calls
    assert "laser on" not in bed.tape.calls
