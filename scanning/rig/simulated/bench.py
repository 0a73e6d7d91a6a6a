"""The bench a simulated rig stands on: one physical world that stage, laser and camera share.

The stage's controller moves a carriage, the laser shines or not, and a frame shows what lies under the line where the
carriage *is*, not where the software believes it to be. If driver and camera were simulated apart, a lost step, a
laser left off or an exposure during motion would go unseen.

A bench owns a directory: `stage.tty` (the serial port) and `camera.sock`. Time passes as on a real rig, divided by the
speed-up; rendering counts as part of exposure and read-out, it never adds a pause of its own.
"""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from scanning.errors import BadInput, Fault
from scanning.rig.protocols import Image, SensorMode
from scanning.rig.simulated.camera_wire import Header, WireClosed, receive_message, send_message, socket_path
from scanning.rig.simulated.controller import Controller
from scanning.rig.simulated.wire import MachineClock, Wire

#: Read-out of the sensor: GigE carries about 100 bytes a microsecond, and a frame has some overhead.
READOUT_BYTES_PER_US = 100.0
READOUT_OVERHEAD_US = 300.0
#: An exposure during which the carriage moved more than this shows a smeared picture, in micrometres.
SMEAR_UM = 0.25

Float32 = NDArray[np.float32]


class Light(Protocol):
    """What the bench needs of the optics: see `render.Renderer`."""

    def irradiance(self, position_um: float, laser_on: bool = True) -> Float32: ...
    def expose(self, irradiance: Float32, exposure_us: float, rng: np.random.Generator) -> NDArray[Any]: ...


@dataclass(frozen=True)
class Part:
    """What lies on the rig: a region of a part that begins at stage position ``start_mm``."""

    scene: str
    seed: int = 1
    wear_um: float = 0.0
    start_mm: float = 10.0
    options: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Optics:
    """A part seen by the camera with one region of interest."""

    light: Light
    saturation: int
    response: str


#: Makes the light for a part and a region of interest; tests put a cheap one in its place.
Lighting = Callable[[Part, SensorMode], Optics]


def render_lighting(part: Part, mode: SensorMode) -> Optics:
    """The real thing: coherent light on a rough surface."""
    from scanning.rig.simulated.render import Renderer
    from scanning.rig.simulated.scenes import scene

    renderer = Renderer(
        scene(part.scene, seed=part.seed, wear_um=part.wear_um, **part.options),
        rows=mode.row_offset + mode.rows,
        columns=mode.columns,
        bits=mode.bits,
    )
    return Optics(renderer, renderer.sensor.saturation, renderer.sensor.response)


@dataclass
class CameraFaults:
    """How many of the next frames go wrong in which way."""

    silent: int = 0
    incomplete: int = 0
    wrong_size: int = 0
    stuck: int = 0
    hang_up: int = 0


@dataclass(frozen=True)
class _Shot:
    frame_id: int
    taken_at_s: float
    ready_s: float
    image: Future[Image]


class Bench:
    """Runs controller, laser, part and camera until `stop`."""

    def __init__(
        self,
        directory: Path,
        *,
        speed_up: float = 1.0,
        part: Part | None = None,
        controller: Controller | None = None,
        lighting: Lighting = render_lighting,
    ) -> None:
        if not speed_up > 0:
            raise BadInput(f"The speed-up is {speed_up}; it must be above 0.")
        self.directory = directory
        self.clock = MachineClock(speed_up)
        self.controller = controller or Controller()
        self.wire = Wire(self.controller, directory / "stage.tty", self.clock)
        self.camera_faults = CameraFaults()
        self.frames = 0
        self._lighting = lighting
        self._part = part or Part("R1")
        self._optics: tuple[Part, SensorMode, Optics] | None = None
        self._field: tuple[Optics, tuple[float, ...], float, Float32] | None = None
        self._darkroom = ThreadPoolExecutor(1, thread_name_prefix="darkroom")
        self._server: socket.socket | None = None
        self._guests: set[socket.socket] = set()
        self._stopping = threading.Event()

    @property
    def port(self) -> str:
        return str(self.directory / "stage.tty")

    @property
    def camera_address(self) -> str:
        return str(self.directory / "camera.sock")

    def start(self) -> None:
        self.directory.mkdir(parents=True, exist_ok=True)
        path = Path(self.camera_address)
        path.unlink(missing_ok=True)
        server = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            with socket_path(path) as name:
                server.bind(name)
        except OSError as fault:
            server.close()
            raise BadInput(
                f"The camera's socket {path} cannot be made ({fault}); choose another directory for the simulated rig."
            ) from fault
        server.listen()
        self._server = server
        self.wire.start()
        threading.Thread(target=self._welcome, name="camera-door", daemon=True).start()

    def stop(self) -> None:
        self._stopping.set()
        if self._server is not None:
            with contextlib.suppress(OSError):
                self._server.shutdown(socket.SHUT_RDWR)
            self._server.close()
            Path(self.camera_address).unlink(missing_ok=True)
        for guest in list(self._guests):
            with contextlib.suppress(OSError):
                guest.shutdown(socket.SHUT_RDWR)
        self.wire.stop()
        self._darkroom.shutdown(cancel_futures=True)

    def __enter__(self) -> Bench:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    # ---- truth --------------------------------------------------------------------------------------------------

    def load(self, part: Part) -> None:
        """Put another part on the rig."""
        self._part = part

    def state(self) -> Header:
        with self.wire.lock:
            now = self.wire.catch_up()
            c = self.controller
            return {
                "position_um": c.position_um(now),
                "laser": c.laser_power(now),
                "moving": c.moving(now),
                "controller": c.state,
                "frames": self.frames,
                "scene": self._part.scene,
                "seed": self._part.seed,
                "wear_um": self._part.wear_um,
            }

    def provoke(self, part: str, fault: str, **options: Any) -> None:
        """Let something fail.

        ``camera``: silent, incomplete, wrong_size, stuck, hang_up (``count`` frames). ``stage``: unplug, replug,
        reset, alarm (``code``), garbage (``text``), drop_to_host, drop_to_controller (``count`` bytes), mute, unmute,
        dead_switch; unplug, reset and alarm also with ``in_move=True``: in the middle of the next move."""
        if part == "camera":
            if not hasattr(self.camera_faults, fault):
                raise BadInput(f"The camera has no fault '{fault}'.")
            setattr(self.camera_faults, fault, int(options.get("count", 1)))
            return
        c = self.controller
        act: Callable[[], None] | None = {
            "reset": c.hard_reset,
            "alarm": lambda: c.trip_alarm(int(options.get("code", 1))),
            "unplug": self.wire.unplug,
            "replug": self.wire.replug,
        }.get(fault)
        if act is not None and options.get("in_move"):
            if fault == "unplug":
                self.wire.unplug_in_move()
            else:
                with self.wire.lock:
                    c.faults.in_move = act
        elif act is not None:
            with self.wire.lock:
                self.wire.catch_up()
                act()
        elif fault == "garbage":
            c.faults.garbage = str(options.get("text", "\xff\xfe#")).encode("latin-1")
        elif fault == "drop_to_host":
            c.line.drop_out = int(options.get("count", 1))
        elif fault == "drop_to_controller":
            c.line.drop_in = int(options.get("count", 1))
        elif fault in ("mute", "unmute"):
            c.faults.mute = fault == "mute"
        elif fault == "dead_switch":
            c.faults.dead_switch = True
        else:
            raise BadInput(f"The {part} has no fault '{fault}'.")

    # ---- camera -------------------------------------------------------------------------------------------------

    def _welcome(self) -> None:
        assert self._server is not None
        while not self._stopping.is_set():
            try:
                guest, _ = self._server.accept()
            except OSError:
                return
            self._guests.add(guest)
            threading.Thread(target=self._serve, args=(guest,), name="camera", daemon=True).start()

    def _serve(self, guest: socket.socket) -> None:
        exposure = _Exposures(self)
        try:
            while True:
                request, _ = receive_message(guest)
                try:
                    self._answer(guest, exposure, request)
                except Fault as fault:
                    send_message(guest, {"fault": str(fault)})
                except (KeyError, TypeError, ValueError) as fault:
                    send_message(guest, {"fault": f"The simulated rig cannot do {request.get('do')!r}: {fault}."})
        except (WireClosed, OSError):
            pass
        finally:
            self._guests.discard(guest)
            guest.close()

    def _answer(self, guest: socket.socket, exposures: _Exposures, request: Header) -> None:
        do = request.get("do")
        if do == "expose":
            exposures.expose(float(request["exposure_us"]))
            send_message(guest, {})
        elif do == "read":
            exposures.read(guest)
        elif do == "configure":
            keys = ("rows", "columns", "row_offset", "column_offset", "bits")
            optics = exposures.configure(SensorMode(**{key: int(request[key]) for key in keys}))
            send_message(guest, {"saturation": optics.saturation, "response": optics.response})
        elif do == "load":
            options = dict(request.get("options") or {})
            start_mm = float(options.pop("start_mm", self._part.start_mm))
            part = Part(str(request["scene"]), int(request["seed"]), float(request["wear_um"]), start_mm, options)
            # Build it now, in the region of interest used last: a part that cannot be is refused here, not in the scan.
            mode = self._optics[1] if self._optics else SensorMode(rows=16, columns=64)
            self._darkroom.submit(self.optics, part, mode).result()
            self.load(part)
            send_message(guest, {})
        elif do == "state":
            send_message(guest, self.state())
        elif do == "provoke":
            self.provoke(str(request["part"]), str(request["fault"]), **dict(request.get("options") or {}))
            send_message(guest, {})
        else:
            raise BadInput(f"The simulated camera does not know '{do}'.")

    def optics(self, part: Part, mode: SensorMode) -> Optics:
        """The optics for ``part``, built once and kept. Runs in the darkroom: renderers are not thread-safe."""
        if self._optics is None or self._optics[:2] != (part, mode):
            if mode.column_offset:
                raise BadInput("The simulated camera centres its columns on the laser line; set column_offset to 0.")
            try:
                made = self._lighting(part, mode)
            except TypeError as fault:
                raise BadInput(f"The part {part.scene} cannot be laid on the rig: {fault}.") from fault
            self._optics = (part, mode, made)
        return self._optics[2]

    def develop(self, part: Part, mode: SensorMode, shot: tuple[float, tuple[float, ...], float, int]) -> Image:
        """Make the picture of one exposure: (exposure_us, stage positions in um, laser power, frame id)."""
        exposure_us, positions_um, power, frame_id = shot
        optics = self.optics(part, mode)
        light = optics.light
        cached = self._field
        if cached is not None and cached[0] is optics and cached[1:3] == (positions_um, power):
            irradiance = cached[3]
        else:
            where = [p - part.start_mm * 1000 for p in positions_um]
            irradiance = np.mean([light.irradiance(p, power > 0) for p in where], axis=0, dtype=np.float32)
            if 0 < power < 1:
                dark = light.irradiance(where[0], False)
                irradiance = dark + np.float32(power) * (irradiance - dark)
            self._field = (optics, positions_um, power, irradiance)
        image: Image = light.expose(irradiance, exposure_us, np.random.default_rng((part.seed, frame_id)))
        return image[mode.row_offset :]


class _Exposures:
    """What one host has exposed and not read yet."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        self._mode: SensorMode | None = None
        self._shots: deque[_Shot] = deque()
        self._sensor_free_s = 0.0
        self._last_id = 0

    def configure(self, mode: SensorMode) -> Optics:
        bench = self._bench
        optics = bench._darkroom.submit(bench.optics, bench._part, mode).result()
        self._mode = mode
        self._shots.clear()
        return optics

    def expose(self, exposure_us: float) -> None:
        bench, mode = self._bench, self._mode
        if mode is None:
            raise BadInput("The camera has no region of interest yet; configure it before exposing.")
        begin_s, at_begin, power = self._look()
        # A sensor cannot hand over an image before the one before it has been read out.
        end_s = max(begin_s + exposure_us * 1e-6, self._sensor_free_s)
        _sleep_until(bench.clock, end_s)
        _, at_end, power_at_end = self._look()
        moved = abs(at_end - at_begin) > SMEAR_UM
        positions = (at_begin, (at_begin + at_end) / 2, at_end) if moved else (at_begin,)
        readout_us = (
            READOUT_OVERHEAD_US + mode.rows * mode.columns * (1 if mode.bits <= 8 else 2) / READOUT_BYTES_PER_US
        )
        self._sensor_free_s = end_s + readout_us * 1e-6
        bench.frames += 1
        shot = (exposure_us, positions, min(power, power_at_end), bench.frames)
        image = bench._darkroom.submit(bench.develop, bench._part, mode, shot)
        self._shots.append(_Shot(bench.frames, begin_s, self._sensor_free_s, image))

    def _look(self) -> tuple[float, float, float]:
        wire = self._bench.wire
        with wire.lock:
            now = wire.catch_up()
            return now, round(wire.controller.position_um(now), 4), wire.controller.laser_power(now)

    def read(self, guest: socket.socket) -> None:
        if not self._shots or self._mode is None:
            raise BadInput("There is no exposed frame to read out; expose first.")
        shot = self._shots.popleft()
        image = shot.image.result()
        _sleep_until(self._bench.clock, shot.ready_s)
        faults = self._bench.camera_faults
        if _use(faults, "silent"):
            return
        if _use(faults, "hang_up"):
            raise WireClosed("provoked")
        if _use(faults, "wrong_size"):
            image = image[:, :-1]
        frame_id = self._last_id if _use(faults, "stuck") else shot.frame_id
        self._last_id = frame_id
        payload = image.tobytes()
        if _use(faults, "incomplete"):
            payload = payload[: len(payload) // 3]
        header = {
            "rows": image.shape[0],
            "columns": image.shape[1],
            "bits": 8 if image.dtype == np.uint8 else 16,
            "frame_id": frame_id,
            "taken_at_s": shot.taken_at_s,
            "bytes": len(payload),
        }
        send_message(guest, header, payload)


def _use(faults: CameraFaults, name: str) -> bool:
    left = getattr(faults, name)
    if left > 0:
        setattr(faults, name, left - 1)
    return bool(left > 0)


def _sleep_until(clock: MachineClock, machine_s: float) -> None:
    left = clock.real(machine_s - clock.now())
    if left > 0:
        time.sleep(left)
