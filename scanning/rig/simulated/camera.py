"""The simulated rig's camera as its host sees it: a `Camera` behind a unix socket.

It knows nothing of optics; it asks the bench process and believes nothing it gets back until sizes agree, as with a
camera on a network. ``load_part`` and ``bench_state`` are what a person does and sees at a real rig: put a tool on it,
look whether the laser is on.
"""

from __future__ import annotations

import socket
import time
from pathlib import Path
from typing import Any

import numpy as np

from scanning.errors import CameraFault
from scanning.rig.protocols import Frame, Image, SensorMode
from scanning.rig.simulated.camera_wire import Header, WireClosed, receive_message, send_message, socket_path

#: Longest wait for an answer that needs no light, in seconds. The first scene compiles its kernels: give it a minute.
ANSWER_S = 60.0


class SimulatedCamera:
    """`Camera` and `OverlappingCamera` served by a `Bench` at unix socket ``address``."""

    def __init__(self, address: str) -> None:
        self.address = address
        self.saturation = 255
        self.response = "linear"
        self._mode: SensorMode | None = None
        self._link: socket.socket | None = None
        self._unread: list[float] = []

    def open(self) -> None:
        self.close()
        link = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            link.settimeout(5.0)
            with socket_path(Path(self.address)) as name:
                link.connect(name)
        except OSError as fault:
            link.close()
            raise CameraFault(
                f"The simulated camera at {self.address} cannot be reached ({fault.strerror or fault}); "
                "start it with 'python -m scanning.rig.simulated'."
            ) from fault
        self._link = link
        self._unread = []
        if self._mode is not None:
            self.configure(self._mode)

    def close(self) -> None:
        link, self._link = self._link, None
        if link is not None:
            link.close()

    def configure(self, mode: SensorMode) -> None:
        answer = self._ask(
            {
                "do": "configure",
                "rows": mode.rows,
                "columns": mode.columns,
                "row_offset": mode.row_offset,
                "column_offset": mode.column_offset,
                "bits": mode.bits,
            }
        )
        self._unread = []
        self._mode = mode
        self.saturation = int(answer["saturation"])
        self.response = str(answer["response"])

    def grab(self, exposure_us: float, *, timeout_s: float) -> Frame:
        self.expose(exposure_us, timeout_s=timeout_s)
        return self.read_out(timeout_s=timeout_s)

    def expose(self, exposure_us: float, *, timeout_s: float) -> None:
        if self._mode is None:
            raise CameraFault("The camera has no region of interest yet; configure it before exposing.")
        self._ask({"do": "expose", "exposure_us": exposure_us}, timeout_s=timeout_s + exposure_us * 1e-6)
        self._unread.append(exposure_us)

    def read_out(self, *, timeout_s: float) -> Frame:
        mode = self._mode
        if mode is None or not self._unread:
            raise CameraFault("There is no exposed frame to read out; expose first.")
        exposure_us = self._unread.pop(0)
        header, payload = self._exchange({"do": "read"}, timeout_s=timeout_s + exposure_us * 1e-6)
        rows, columns = int(header["rows"]), int(header["columns"])
        kind = np.dtype(np.uint8 if int(header["bits"]) <= 8 else np.uint16)
        if len(payload) != rows * columns * kind.itemsize:
            raise CameraFault(
                f"The camera sent an incomplete frame ({len(payload)} of {rows * columns * kind.itemsize} bytes); "
                "check the camera's cable and the load on its network."
            )
        image: Image = np.frombuffer(payload, dtype=kind).reshape(rows, columns)
        return Frame(image, exposure_us, int(header["frame_id"]), float(header["taken_at_s"]))

    # ---- what a person does at the rig --------------------------------------------------------------------------

    def load_part(self, scene: str, seed: int = 1, wear_um: float = 0.0, **options: Any) -> None:
        """Put the region ``scene`` of a part on the rig. ``options`` go to `scenes.scene`; ``start_mm`` is the stage
        position at which the region begins."""
        self._ask({"do": "load", "scene": scene, "seed": seed, "wear_um": wear_um, "options": options})

    def bench_state(self) -> Header:
        """The physical truth: ``position_um``, ``laser`` (0..1), ``controller`` state, ``moving``, ``frames``."""
        return self._ask({"do": "state"})

    def provoke(self, part: str, fault: str, **options: Any) -> None:
        """Make the ``camera`` or the ``stage`` fail on purpose; see `Bench.provoke`."""
        self._ask({"do": "provoke", "part": part, "fault": fault, "options": options})

    # ---- how ----------------------------------------------------------------------------------------------------

    def _ask(self, request: Header, *, timeout_s: float = ANSWER_S) -> Header:
        return self._exchange(request, timeout_s=timeout_s)[0]

    def _exchange(self, request: Header, *, timeout_s: float) -> tuple[Header, bytes]:
        if self._link is None:
            self.open()
        link = self._link
        assert link is not None
        try:
            link.settimeout(timeout_s)
            send_message(link, request)
            header, payload = receive_message(link, time.monotonic() + timeout_s)
        except TimeoutError as silence:
            self.close()  # a late answer must not be taken for the next one's
            raise CameraFault(
                f"The camera at {self.address} sent nothing within {timeout_s:.2f} s; "
                "check its supply, cable and trigger."
            ) from silence
        except (WireClosed, OSError) as fault:
            self.close()
            raise CameraFault(
                f"The connection to the camera at {self.address} broke ({fault}); check its supply and cable."
            ) from fault
        if "fault" in header:
            raise CameraFault(str(header["fault"]))
        return header, payload
