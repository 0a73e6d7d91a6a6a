"""Basler cameras through pypylon (optional: ``pip install --require-hashes -r requirements-cameras.txt``).

Frames are triggered by software, one at a time, with everything automatic switched off: a camera that chose gain or
exposure by itself would make the exposures of a bracket incomparable. The stage may move on when the shutter has
closed; a camera tells the host so only indirectly, so the time is waited out: exposure plus ``shutter_margin_us``, the
longest time the trigger may take to reach the sensor.

Proven against the camera emulator of Basler's SDK (``PYLON_CAMEMU=1``), which sends real buffers through the real
driver; see docs/hardware.md for what that leaves open.
"""

from __future__ import annotations

import importlib
import math
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Any

from scanning.errors import BadInput, CameraFault
from scanning.rig.frame_numbers import FrameNumbers
from scanning.rig.protocols import Frame, SensorMode
from scanning.rig.sensor_pixels import SensorRegion, frame_image, sensor_format, sensor_region

#: Buffers that wait for the camera; more than the exposures of any bracket.
BUFFERS = 16
#: Largest deviation of the exposure the camera sets from the one asked for, as a share.
EXPOSURE_TOLERANCE = 0.01
#: Set on every camera that has them, so that a picture depends on light and exposure alone.
_FIXED: tuple[tuple[str, object], ...] = (
    ("ExposureAuto", "Off"), ("GainAuto", "Off"), ("ExposureMode", "Timed"), ("GammaEnable", False), ("Gamma", 1.0),
    ("AcquisitionFrameRateEnable", False), ("AcquisitionMode", "Continuous"),
    ("TriggerSelector", "FrameStart"), ("TriggerMode", "On"), ("TriggerSource", "Software"),
)  # fmt: skip
_MUST = frozenset(("TriggerSelector", "TriggerMode", "TriggerSource"))


class PylonCamera:
    """`Camera` and `OverlappingCamera` for one Basler camera.

    ``serial`` None takes the only camera there is. ``pixel_format`` is a GenICam name (`sensor_format`). ``turned``:
    the laser line lies along the sensor's rows. ``gain`` in the camera's own unit, None leaves it. ``features`` are
    further nodes to set by name after opening.
    """

    response = "linear"

    def __init__(
        self,
        serial: str | None = None,
        *,
        pixel_format: str = "Mono8",
        turned: bool = False,
        gain: float | None = None,
        shutter_margin_us: float = 2000.0,
        features: Mapping[str, Any] | None = None,
    ) -> None:
        if not (math.isfinite(shutter_margin_us) and shutter_margin_us >= 0):
            raise BadInput(f"The camera's shutter margin is {shutter_margin_us} us; set a time that is not negative.")
        self.serial = serial
        self.pixels = sensor_format(pixel_format)
        self.saturation = self.pixels.saturation
        self.pitch_factor = self.pixels.pitch_factor
        self._turned = turned
        self._gain = gain
        self._margin_s = shutter_margin_us * 1e-6
        self._features = dict(features or {})
        self._sdk: Any = None
        self._genicam: Any = None
        self._camera: Any = None
        self._region: SensorRegion | None = None
        self._numbers = FrameNumbers()
        self._unread: list[float] = []
        self._exposure_us: float | None = None

    @property
    def _name(self) -> str:
        return f"Basler camera {self.serial}" if self.serial else "Basler camera"

    # ---- Camera -------------------------------------------------------------------------------------------------

    def open(self) -> None:
        self.close()
        try:
            self._sdk = importlib.import_module("pypylon.pylon")
            self._genicam = importlib.import_module("pypylon.genicam")
        except ImportError as absent:
            raise CameraFault(
                f"The {self._name} needs Basler's driver, which is not installed here; "
                "run 'pip install --require-hashes -r requirements-cameras.txt'."
            ) from absent
        with self._trouble("opening"):
            factory = self._sdk.TlFactory.GetInstance()
            found = list(factory.EnumerateDevices())
            fitting = [info for info in found if self.serial in (None, info.GetSerialNumber())]
            if len(fitting) != 1:
                names = ", ".join(info.GetSerialNumber() for info in found) or "none"
                raise CameraFault(
                    f"{len(fitting)} cameras fit the {self._name} (found: {names}); "
                    "check its cable and supply and the serial number in the rig's settings."
                )
            self.serial = fitting[0].GetSerialNumber()
            self._camera = self._sdk.InstantCamera(factory.CreateDevice(fitting[0]))
        try:
            with self._trouble("opening"):
                self._camera.Open()
                self._camera.MaxNumBuffer.Value = BUFFERS
            for feature, value in _FIXED:
                self._set(feature, value, must=feature in _MUST)
            if self._gain is not None:
                with self._trouble("setting the gain of"):
                    gain = "Gain" if self._node("Gain") is not None else "GainRaw"
                self._set(gain, self._gain)
            for feature, value in self._features.items():
                self._set(feature, value)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Let go of the camera. Never raises."""
        camera, self._camera = self._camera, None
        self._region, self._exposure_us = None, None
        self._unread.clear()
        if camera is not None:
            with suppress(Exception):  # a camera that is gone cannot be closed, and that is fine
                camera.StopGrabbing()
            with suppress(Exception):
                camera.Close()

    def configure(self, mode: SensorMode) -> None:
        region = sensor_region(mode, self.pixels, turned=self._turned)
        if self._camera is None:
            self.open()
        self._unread.clear()
        with self._trouble("configuring"):
            self._camera.StopGrabbing()
        self._set("PixelFormat", self.pixels.name)
        # Offsets first to zero: a sensor refuses a size that its old offset would push over the edge.
        for feature, value in (
            ("OffsetX", 0), ("OffsetY", 0), ("Width", region.width), ("Height", region.height),
            ("OffsetX", region.left), ("OffsetY", region.top),
        ):  # fmt: skip
            self._set(feature, value, must=value != 0)
        self._region = region
        self._start()

    def grab(self, exposure_us: float, *, timeout_s: float) -> Frame:
        self._trigger(exposure_us, timeout_s)
        return self.read_out(timeout_s=timeout_s)

    def expose(self, exposure_us: float, *, timeout_s: float) -> None:
        self._trigger(exposure_us, timeout_s)
        time.sleep(exposure_us * 1e-6 + self._margin_s)

    def read_out(self, *, timeout_s: float) -> Frame:
        region = self._region
        if region is None or not self._unread:
            raise CameraFault(f"The {self._name} holds no exposed frame; expose first.")
        exposure_us = self._unread.pop(0)
        timeout_ms = math.ceil(1000 * (timeout_s + exposure_us * 1e-6))
        with self._trouble("reading a frame from"):
            result = self._camera.RetrieveResult(timeout_ms, self._sdk.TimeoutHandling_Return)
            if result is None or not result.IsValid():
                self._abandon()
                raise CameraFault(
                    f"The {self._name} sent nothing within {timeout_s:.2f} s; check its supply, cable and trigger."
                )
            try:
                if not result.GrabSucceeded():
                    why = result.GetErrorDescription().strip().rstrip(".")
                    raise CameraFault(
                        f"The {self._name} sent an incomplete frame ({why}); "
                        "check its cable and the load on its network."
                    )
                image = frame_image(result.Array, region, self.pixels, turned=self._turned)
                number = self._numbers.number(int(result.BlockID))
            finally:
                result.Release()
        return Frame(image, exposure_us, number, time.monotonic())

    # ---- how ----------------------------------------------------------------------------------------------------

    def _trigger(self, exposure_us: float, timeout_s: float) -> None:
        if self._region is None:
            raise CameraFault(f"The {self._name} has no region of interest yet; configure it before exposing.")
        with self._trouble("starting"):
            if not self._camera.IsGrabbing():
                self._start()
        if exposure_us != self._exposure_us:
            self._set_exposure(exposure_us)
        with self._trouble("triggering"):
            if not self._camera.WaitForFrameTriggerReady(math.ceil(1000 * timeout_s), self._sdk.TimeoutHandling_Return):
                self._abandon()
                raise CameraFault(
                    f"The {self._name} takes no trigger within {timeout_s:.2f} s; check its trigger settings."
                )
            self._camera.ExecuteSoftwareTrigger()
        self._unread.append(exposure_us)

    def _start(self) -> None:
        self._numbers.restart()
        self._unread.clear()
        with self._trouble("starting"):
            self._camera.StartGrabbing(self._sdk.GrabStrategy_OneByOne)

    def _abandon(self) -> None:
        """Forget what is under way: a frame that comes late must not be taken for the next one."""
        self._unread.clear()
        self._camera.StopGrabbing()

    def _set_exposure(self, exposure_us: float) -> None:
        self._exposure_us = None
        with self._trouble("setting the exposure of"):
            feature = "ExposureTime" if self._node("ExposureTime") is not None else "ExposureTimeAbs"
            self._set(feature, exposure_us)
            node = self._node(feature)
            set_us = float(node.Value) if node is not None else math.nan
        if not abs(set_us - exposure_us) <= EXPOSURE_TOLERANCE * exposure_us:
            raise CameraFault(
                f"The {self._name} exposes for {set_us:g} us when asked for {exposure_us:g} us; "
                "choose exposure times it can make."
            )
        self._exposure_us = exposure_us

    def _node(self, feature: str) -> Any | None:
        node = self._camera.GetNodeMap().GetNode(feature)
        return node if node is not None and self._genicam.IsAvailable(node) else None

    def _set(self, feature: str, value: object, *, must: bool = True) -> None:
        """Set a node by name. One that is absent or fixed is passed over unless it must be set."""
        with self._trouble(f"setting {feature} of"):
            node = self._node(feature)
            if node is None or not self._genicam.IsWritable(node):
                if must and (node is None or node.Value != value):
                    raise CameraFault(
                        f"The {self._name} cannot set {feature} to {value}; correct the rig's camera settings."
                    )
                return
            try:
                node.Value = value
            except (self._genicam.GenericException, TypeError, ValueError) as refusal:
                raise CameraFault(
                    f"The {self._name} refuses {feature} = {value} ({_first_sentence(refusal)}); "
                    "correct the rig's camera settings."
                ) from refusal

    @contextmanager
    def _trouble(self, doing: str) -> Iterator[None]:
        """Whatever the SDK raises, as one sentence."""
        try:
            yield
        except CameraFault:
            raise
        except Exception as fault:
            gone = False
            with suppress(Exception):
                gone = self._camera is not None and self._camera.IsCameraDeviceRemoved()
            if gone:
                self.close()
                raise CameraFault(
                    f"The {self._name} was disconnected; check its cable and supply, then open the rig again."
                ) from fault
            raise CameraFault(
                f"There was trouble {doing} the {self._name} ({_first_sentence(fault)}); "
                "check its cable and supply, and that no other program uses it."
            ) from fault


def _first_sentence(fault: Exception) -> str:
    return str(fault).split(" : ")[0].split(". ")[0].strip().rstrip(".") or type(fault).__name__
