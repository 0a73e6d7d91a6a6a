"""Any camera with a GenTL producer, through harvesters (optional: see requirements-cameras.txt).

Every maker of industrial cameras ships a ``.cti`` file that speaks the same interface (EMVA GenTL); one adapter reaches
all of them. It is the second choice beside a maker's own driver: harvesters waits by polling, and what the producer
reports about a lost frame differs from maker to maker.

Proven against the simulator producer in the ``genicam`` wheel. That one has neither trigger nor exposure, hence
``trigger="none"`` and ``fixed_exposure_us`` for cameras of this kind: each frame is then the first of an acquisition
that was started for it, so none is older than the request.
"""

from __future__ import annotations

import importlib
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from scanning.errors import BadInput, CameraFault
from scanning.rig.frame_numbers import FrameNumbers
from scanning.rig.protocols import Frame, SensorMode
from scanning.rig.sensor_pixels import SensorRegion, frame_image, sensor_format, sensor_region

#: Largest deviation of the exposure the camera sets from the one asked for, as a share.
EXPOSURE_TOLERANCE = 0.01
#: Set on every camera that has them, so that a picture depends on light and exposure alone.
_FIXED: tuple[tuple[str, object], ...] = (
    ("ExposureAuto", "Off"), ("GainAuto", "Off"), ("ExposureMode", "Timed"), ("Gamma", 1.0),
    ("AcquisitionFrameRateEnable", False), ("AcquisitionMode", "Continuous"),
)  # fmt: skip
_TRIGGER: tuple[tuple[str, object], ...] = (
    ("TriggerSelector", "FrameStart"), ("TriggerMode", "On"), ("TriggerSource", "Software"),
)  # fmt: skip


#: A producer is loaded once per process; the two cameras of a two-sided rig share it: file -> (harvester, users).
_producers: dict[str, tuple[Any, int]] = {}
_loading = threading.Lock()


def _take_producer(core: Any, file: str) -> Any:
    with _loading:
        harvester, users = _producers.get(file, (None, 0))
        if harvester is None:
            harvester = core.Harvester()
            harvester.add_file(file)
            harvester.update()
        _producers[file] = harvester, users + 1
        return harvester


def _give_back_producer(file: str) -> None:
    with _loading:
        harvester, users = _producers.pop(file)
        if users > 1:
            _producers[file] = harvester, users - 1
        else:
            harvester.reset()


class GenTLCamera:
    """`Camera` for one device of the GenTL producer file ``producer`` (.cti).

    ``serial`` None takes the only device there is. ``trigger`` is ``software``, or ``none`` for a device that cannot be
    triggered. ``fixed_exposure_us`` is what a device without an exposure setting exposes for. The rest as in
    `PylonCamera`.
    """

    response = "linear"

    def __init__(
        self,
        producer: str,
        *,
        serial: str | None = None,
        pixel_format: str = "Mono8",
        turned: bool = False,
        gain: float | None = None,
        trigger: str = "software",
        fixed_exposure_us: float | None = None,
        features: Mapping[str, Any] | None = None,
    ) -> None:
        if trigger not in ("software", "none"):
            raise BadInput(f"The camera's trigger is '{trigger}'; set it to 'software' or 'none'.")
        self.producer = producer
        self.serial = serial
        self.pixels = sensor_format(pixel_format)
        self.saturation = self.pixels.saturation
        self.pitch_factor = self.pixels.pitch_factor
        self._turned = turned
        self._gain = gain
        self._triggered = trigger == "software"
        self._fixed_exposure_us = fixed_exposure_us
        self._features = dict(features or {})
        self._harvester: Any = None
        self._device: Any = None
        self._region: SensorRegion | None = None
        self._numbers = FrameNumbers()
        self._incomplete = 0
        self._exposure_us: float | None = None

    @property
    def _name(self) -> str:
        return f"GenTL camera {self.serial}" if self.serial else "GenTL camera"

    # ---- Camera -------------------------------------------------------------------------------------------------

    def open(self) -> None:
        self.close()
        try:
            core = importlib.import_module("harvesters.core")
        except ImportError as absent:
            raise CameraFault(
                f"The {self._name} needs harvesters, which is not installed here; "
                "run 'pip install --require-hashes -r requirements-cameras.txt'."
            ) from absent
        if not Path(self.producer).is_file():
            raise CameraFault(
                f"There is no GenTL producer {self.producer}; install the camera maker's driver and give its .cti file."
            )
        try:
            with self._trouble("opening"):
                self._harvester = _take_producer(core, self.producer)
                found = [str(info.serial_number) for info in self._harvester.device_info_list]
                fitting = [k for k, serial in enumerate(found) if self.serial in (None, serial)]
                if len(fitting) != 1:
                    raise CameraFault(
                        f"{len(fitting)} cameras fit the {self._name} (found: {', '.join(found) or 'none'}); "
                        "check its cable and supply and the serial number in the rig's settings."
                    )
                self.serial = found[fitting[0]]
                self._device = self._harvester.create(fitting[0])
                # harvesters drops incomplete frames and tells only callbacks of its own class.
                told = type("IncompleteFrames", (core.Callback,), {"emit": lambda _, context=None: self._count()})()
                self._device.add_callback(self._device.Events.INCOMPLETE_BUFFER, told)
            for feature, value in _FIXED:
                self._set(feature, value, must=False)
            if self._triggered:
                for feature, value in _TRIGGER:
                    self._set(feature, value)
            if self._gain is not None:
                self._set("Gain", self._gain)
            for feature, value in self._features.items():
                self._set(feature, value)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Let go of the camera. Never raises."""
        device, self._device = self._device, None
        harvester, self._harvester = self._harvester, None
        self._region, self._exposure_us = None, None
        if device is not None:
            with suppress(Exception):  # a camera that is gone cannot be closed, and that is fine
                device.stop()
            with suppress(Exception):
                device.destroy()
        if harvester is not None:
            with suppress(Exception):
                _give_back_producer(self.producer)

    def configure(self, mode: SensorMode) -> None:
        region = sensor_region(mode, self.pixels, turned=self._turned)
        if self._device is None:
            self.open()
        self._stop()
        self._set("PixelFormat", self.pixels.name)
        # Offsets first to zero: a sensor refuses a size that its old offset would push over the edge.
        for feature, value in (
            ("OffsetX", 0), ("OffsetY", 0), ("Width", region.width), ("Height", region.height),
            ("OffsetX", region.left), ("OffsetY", region.top),
        ):  # fmt: skip
            self._set(feature, value, must=value != 0)
        self._region = region

    def grab(self, exposure_us: float, *, timeout_s: float) -> Frame:
        region = self._region
        if region is None:
            raise CameraFault(f"The {self._name} has no region of interest yet; configure it before exposing.")
        if exposure_us != self._exposure_us:
            self._set_exposure(exposure_us)
        incomplete = self._incomplete
        with self._trouble("reading a frame from"):
            self._start()
            if self._triggered:
                self._device.remote_device.node_map.get_node("TriggerSoftware").execute()
            buffer = self._device.try_fetch(timeout=timeout_s + exposure_us * 1e-6)
            if self._incomplete != incomplete:
                if buffer is not None:
                    buffer.queue()
                self._stop()
                raise CameraFault(
                    f"The {self._name} sent an incomplete frame; check its cable and the load on its network."
                )
            if buffer is None:
                self._stop()  # a frame that comes late must not be taken for the next one
                raise CameraFault(
                    f"The {self._name} sent nothing within {timeout_s:.2f} s; check its supply, cable and trigger."
                )
            try:
                part = buffer.payload.components[0]
                if part.data_format != self.pixels.name:
                    raise CameraFault(
                        f"The {self._name} sent pixels of format {part.data_format} instead of {self.pixels.name}; "
                        "check its pixel format."
                    )
                data = np.asarray(part.data)
                if data.size == part.height * part.width:
                    data = data.reshape(part.height, part.width)
                image = frame_image(data, region, self.pixels, turned=self._turned)
                number = self._numbers.number(int(buffer.module.frame_id))
            finally:
                buffer.queue()
        if not self._triggered:
            self._stop()
        return Frame(image, exposure_us, number, time.monotonic())

    # ---- how ----------------------------------------------------------------------------------------------------

    def _count(self) -> None:
        self._incomplete += 1

    def _start(self) -> None:
        if not self._device.is_acquiring():
            self._numbers.restart()
            self._device.start()

    def _stop(self) -> None:
        with self._trouble("stopping"):
            if self._device.is_acquiring():
                self._device.stop()

    def _set_exposure(self, exposure_us: float) -> None:
        self._exposure_us = None
        nodes = self._device.remote_device.node_map
        names = [name for name in ("ExposureTime", "ExposureTimeAbs") if nodes.has_node(name)]
        if not names:
            if self._fixed_exposure_us is None:
                raise CameraFault(
                    f"The {self._name} has no exposure setting; state its exposure as fixed_exposure_us in the rig's "
                    "camera settings."
                )
            set_us = self._fixed_exposure_us
        else:
            self._set(names[0], exposure_us)
            set_us = float(nodes.get_node(names[0]).value)
        if not abs(set_us - exposure_us) <= EXPOSURE_TOLERANCE * exposure_us:
            raise CameraFault(
                f"The {self._name} exposes for {set_us:g} us when asked for {exposure_us:g} us; "
                "choose exposure times it can make."
            )
        self._exposure_us = exposure_us

    def _set(self, feature: str, value: object, *, must: bool = True) -> None:
        """Set a node by name. One that is absent is passed over unless it must be set."""
        with self._trouble(f"setting {feature} of"):
            nodes = self._device.remote_device.node_map
            if not nodes.has_node(feature):
                if must:
                    raise CameraFault(f"The {self._name} has no {feature}; correct the rig's camera settings.")
                return
            try:
                nodes.get_node(feature).value = value
            except Exception as refusal:
                if not must:
                    return
                raise CameraFault(
                    f"The {self._name} refuses {feature} = {value} ({str(refusal).split(' : ')[0].rstrip('. ')}); "
                    "correct the rig's camera settings."
                ) from refusal

    @contextmanager
    def _trouble(self, doing: str) -> Iterator[None]:
        """Whatever harvesters or the producer raises, as one sentence."""
        try:
            yield
        except CameraFault:
            raise
        except Exception as fault:
            raise CameraFault(
                f"There was trouble {doing} the {self._name} ({str(fault).split(' : ')[0] or type(fault).__name__}); "
                "check its cable and supply, and that no other program uses it."
            ) from fault
