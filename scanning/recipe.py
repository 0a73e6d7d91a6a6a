"""A Recipe: which operations, in which order, with which parameters, turn scan images into a range image.

The same frames give other heights under another recipe, so a recipe travels with every result, in full and with its
hash. Without it "processed with HDRE-II" would mean whatever the code happened to do that month.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Literal

from scanning.errors import BadInput
from scanning.frames import StackHeader

FORMAT = "edgewatch-recipe/1"
Response = Literal["any", "linear", "logarithmic"]
MOST_FRAMES_AVERAGED = 64


def _shown(value: object) -> str:
    return json.dumps(value) if isinstance(value, (str, bool)) else str(value)


def _number(key: str, value: Any, low: float, high: float, *, above: bool = False) -> float:
    ok = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    if not ok or value < low or value > high or (above and value == low):
        span = f"above {low:g} and at most {high:g}" if above else f"from {low:g} to {high:g}"
        raise BadInput(f"Recipe setting {key} is {_shown(value)}; it must be a number {span}.")
    return float(value)


def _choice(key: str, value: Any, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        raise BadInput(f"Recipe setting {key} is {_shown(value)}; it must be one of {', '.join(allowed)}.")


@dataclass(frozen=True)
class Compound:
    """SCI, eq. (4): the mean of ``window`` neighbouring scan images, never rounded.

    ``block`` takes images nN ... (n+1)N-1 and makes the profile pitch N steps (1205 images give 241 profiles at
    41.65 um); ``sliding`` keeps the step as pitch. Only full windows give a profile.
    """

    key: ClassVar[str] = "sci"
    mode: str = "block"
    window: int = 5

    def __post_init__(self) -> None:
        _choice("sci.mode", self.mode, ("block", "sliding"))
        if not isinstance(self.window, int) or not 1 <= self.window <= MOST_FRAMES_AVERAGED:
            raise BadInput(
                f"Recipe setting sci.window is {_shown(self.window)}; it must be a whole number of images from 1 to "
                f"{MOST_FRAMES_AVERAGED}."
            )


@dataclass(frozen=True)
class Exposure:
    """HDRE, eq. (5), (6): per pixel the longest exposure that is not saturated, divided by its time.

    After averaging (HDRE-I) a pixel is saturated when ``all`` of the averaged images are (the literal reading, for the
    mean is the saturation level only then) or when ``any`` of them is (the physically better one). A stack must have at
    least ``fewest`` exposures; with one, its light is taken as it is.
    """

    key: ClassVar[str] = "hdre"
    saturated: str = "all"
    fewest: int = 2

    def __post_init__(self) -> None:
        if not isinstance(self.fewest, int) or not 1 <= self.fewest <= MOST_FRAMES_AVERAGED:
            raise BadInput(f"Recipe setting hdre.fewest is {_shown(self.fewest)}; it must be a whole number from 1.")
        _choice("hdre.saturated", self.saturated, ("all", "any"))


@dataclass(frozen=True)
class Tone:
    """GLT, eq. (7): T(g) = 255 (log(g+1) / log 256)^p with g in 0..255."""

    key: ClassVar[str] = "glt"
    p: float = 0.5

    def __post_init__(self) -> None:
        _number("glt.p", self.p, 0.0, 10.0, above=True)


@dataclass(frozen=True)
class Line:
    """MSNN: which peak of each row is the laser line. ``scanning/pipeline/line.py`` explains every parameter.

    ``k``: threshold as a multiple of the mean of the image; None means 3, or 1.5 on compressed grey (after GLT, or
    from a logarithmic camera). ``floor``: the threshold is never under this share of the row's maximum; None means
    0.1, after GLT what 0.05 of the light became (0.59 at p = 0.5), 0.6 from a logarithmic camera; with candidates by
    noise 0.02, and after GLT what 0.02 of the light became.
    The share counts from the row's mean (``floor_from`` "row_mean") or from "zero".
    ``ceiling``: the image mean asks for no more than this share of the mean row maximum (0: no ceiling).
    ``snr``: a peak must be higher than this many standard deviations of a pixel's noise; None means 4, or 3 on
    compressed grey, whose noise is lifted. ``grain_px``: peaks this many pixels or less apart are grains of one line
    (0: never; None: 3 px, or a quarter of the line's width where that is more).
    ``width_px``: line width in px, None takes the header's, or estimates it. ``width_factor``: a peak passes the width
    check between width/factor and width*factor. ``gate_px``, ``gate_max_px``: how far the line may move from row to
    row: gate_px (1 + rows missed), at most gate_max_px. ``seed``: ``first`` follows the line from the first good row
    from the bottom; ``best`` also tries others and takes the line most like the line.
    ``candidates``: "noise" takes everything ``snr`` spreads above the noise (standing_out.py; k, floor_from and ceiling
    are not used, ``floor`` is the share of its own height at which a base ends; the centre of gravity is that of the
    light above this level, so that a base of whole pixels does not hold the line back), "threshold" the peaks above the
    paper's threshold. ``continuity``: "path" is the best path through the candidates of all rows (path.py;
    gate_px and seed are not used), ``jump`` its price of a jump, in rows; "nearest" follows the nearest candidate.
    "auto" is noise and path, but threshold and nearest for lines wider than 12 px: there structure is around the line,
    not noise.
    `LITERAL`, or the setting ``msnn.reading=literal``, is the paper to the letter.
    """

    key: ClassVar[str] = "msnn"
    k: float | None = None
    floor: float | None = None
    floor_from: str = "row_mean"
    ceiling: float = 0.5
    snr: float | None = None
    grain_px: float | None = None
    width_px: float | None = None
    width_factor: float = 2.0
    gate_px: float = 12.0
    gate_max_px: float = 64.0
    seed: str = "best"
    candidates: str = "auto"
    continuity: str = "auto"
    jump: float = 10.0

    def __post_init__(self) -> None:
        if self.k is not None:
            _number("msnn.k", self.k, 0.0, 1000.0, above=True)
        if self.floor is not None:
            _number("msnn.floor", self.floor, 0.0, 0.99)
        _choice("msnn.floor_from", self.floor_from, ("row_mean", "zero"))
        _number("msnn.ceiling", self.ceiling, 0.0, 1.0)
        if self.snr is not None:
            _number("msnn.snr", self.snr, 0.0, 1000.0)
        if self.grain_px is not None:
            _number("msnn.grain_px", self.grain_px, 0.0, 1e5)
        if self.width_px is not None:
            _number("msnn.width_px", self.width_px, 0.0, 1e5, above=True)
        _number("msnn.width_factor", self.width_factor, 1.0, 1e6)
        _number("msnn.gate_px", self.gate_px, 0.0, 1e6)
        _number("msnn.gate_max_px", self.gate_max_px, self.gate_px, 1e6)
        _choice("msnn.seed", self.seed, ("first", "best"))
        _choice("msnn.candidates", self.candidates, ("auto", "threshold", "noise"))
        _choice("msnn.continuity", self.continuity, ("auto", "nearest", "path"))
        _number("msnn.jump", self.jump, 0.0, 1000.0)


LITERAL: dict[str, str] = {
    "msnn.candidates": "threshold", "msnn.continuity": "nearest", "msnn.floor": "0.1", "msnn.floor_from": "zero",
    "msnn.ceiling": "0", "msnn.snr": "0", "msnn.grain_px": "0", "msnn.seed": "first",
}  # fmt: skip
"""MSNN as the paper prints it; ``msnn.reading=literal`` stands for all of these."""
SHIPPED: dict[str, str] = {
    "msnn.candidates": "auto", "msnn.continuity": "auto", "msnn.floor": "default", "msnn.floor_from": "row_mean",
    "msnn.ceiling": "0.5", "msnn.snr": "default", "msnn.grain_px": "default", "msnn.seed": "best",
}  # fmt: skip


@dataclass(frozen=True)
class Centroid:
    """COG, eq. (8): the centre of gravity of the grey values under the mask MSNN left."""

    key: ClassVar[str] = "cog"


@dataclass(frozen=True)
class Diagonals:
    """Space-time analysis on top of COG: ``scanning/pipeline/space_time.py`` says what it does and why.

    ``angle_deg`` of the triangulation (60 on the paper's rig) gives how far the surface moves on the sensor per step;
    ``px_per_step`` says it outright. ``direction``: to "higher" or "lower" columns; "auto" is seen from the images.
    ``share`` of the way from the centre of gravity in the image to the one in time; None is seen from the images.
    """

    key: ClassVar[str] = "sta"
    angle_deg: float = 60.0
    px_per_step: float | None = None
    direction: str = "auto"
    share: float | None = None

    def __post_init__(self) -> None:
        if self.share is not None:
            _number("sta.share", self.share, 0.0, 1.0)
        _number("sta.angle_deg", self.angle_deg, 1.0, 89.0)
        if self.px_per_step is not None:
            _number("sta.px_per_step", self.px_per_step, 0.0, 1e4, above=True)
        _choice("sta.direction", self.direction, ("auto", "higher", "lower"))


Operation = Compound | Exposure | Tone | Line | Centroid | Diagonals
_OPERATIONS: dict[str, type[Operation]] = {c.key: c for c in (Compound, Exposure, Tone, Line, Centroid, Diagonals)}


@dataclass(frozen=True)
class Recipe:
    """Operations in the order the data flows through them, and which exposures they read.

    ``response`` is the kind of camera the recipe is for. ``exposure`` is which image of a bracket a recipe without
    HDRE reads: "auto" (the one in which most rows are neither dark nor saturated) or its time in microseconds.
    ``exposures_us`` limits HDRE to some of the recorded exposures; None means all of them.
    """

    name: str
    operations: tuple[Operation, ...]
    response: Response = "any"
    exposure: str | float = "auto"
    exposures_us: tuple[float, ...] | None = None

    NAMES: ClassVar[tuple[str, ...]] = ("NF", "SCI", "HDRE-I", "HDRE-II", "HDR-CAM", "PRECISE")

    def __post_init__(self) -> None:
        keys = [o.key for o in self.operations]
        order = ", ".join(keys)
        if (keys[:-1] if keys[-1:] == ["sta"] else keys)[-2:] != ["msnn", "cog"]:
            raise BadInput(f"Recipe {self.name} is {order}; it must end with msnn, cog or with msnn, cog, sta.")
        if len(set(keys)) != len(keys):
            raise BadInput(f"Recipe {self.name} is {order}; each operation may appear once.")
        if "hdre" in keys and "glt" in keys and keys.index("glt") < keys.index("hdre"):
            raise BadInput(f"Recipe {self.name} is {order}; glt must come after hdre, which needs linear grey values.")
        sci = self.compound
        if "sta" in keys and ("glt" in keys or self.comes_before("sci", "hdre") or sci is None or sci.window % 2 == 0):
            raise BadInput(
                f"Recipe {self.name} is {order}; sta follows light through the images of an odd sci window, which must "
                "not be compressed by glt and must be fused before sci."
            )
        if self.response == "logarithmic" and ("hdre" in keys or "glt" in keys):
            raise BadInput(f"Recipe {self.name} is {order}; a logarithmic camera needs neither hdre nor glt.")
        if self.exposure != "auto":
            _number("exposure", self.exposure, 0.0, 1e9)
        if self.exposures_us is not None and (
            not self.exposures_us or tuple(sorted(set(self.exposures_us))) != self.exposures_us
        ):
            raise BadInput(f"Recipe setting exposures is {list(self.exposures_us)}; times must differ and ascend.")

    # -- asking ---------------------------------------------------------------------------------------------------

    def find(self, key: str) -> Operation | None:
        return next((o for o in self.operations if o.key == key), None)

    @property
    def compound(self) -> Compound | None:
        found = self.find("sci")
        return found if isinstance(found, Compound) else None

    @property
    def hdre(self) -> Exposure | None:
        found = self.find("hdre")
        return found if isinstance(found, Exposure) else None

    @property
    def tone(self) -> Tone | None:
        found = self.find("glt")
        return found if isinstance(found, Tone) else None

    @property
    def diagonals(self) -> Diagonals | None:
        found = self.find("sta")
        return found if isinstance(found, Diagonals) else None

    @property
    def line(self) -> Line:
        found = self.find("msnn")
        assert isinstance(found, Line)
        return found

    def comes_before(self, first: str, second: str) -> bool:
        keys = [o.key for o in self.operations]
        return first in keys and second in keys and keys.index(first) < keys.index(second)

    def profile_pitch_um(self, step_um: float) -> float:
        """Distance between profiles along the scan, micrometres: the step, times N for block SCI."""
        sci = self.compound
        return step_um * sci.window if sci is not None and sci.mode == "block" else step_um

    def profiles(self, steps: int) -> int:
        """How many profiles a stack of ``steps`` stage positions gives."""
        sci = self.compound
        if sci is None:
            return steps
        return steps // sci.window if sci.mode == "block" else max(0, steps - sci.window + 1)

    # -- making ---------------------------------------------------------------------------------------------------

    @classmethod
    def named(cls, name: str) -> Recipe:
        """One of the five methods of the paper, or our own PRECISE."""
        make = _NAMED.get(name.upper() if isinstance(name, str) else "")
        if make is None:
            raise BadInput(f"There is no recipe {_shown(name)}; the recipes are {', '.join(cls.NAMES)}.")
        return make()

    def with_settings(self, settings: Mapping[str, str]) -> Recipe:
        """The same recipe with some parameters changed; keys like "sci.mode", "glt.p", "exposure", "exposures"."""
        recipe = self
        for name, text in settings.items():
            if name == "msnn.reading":
                _choice(name, text, ("literal", "shipped"))
                recipe = recipe.with_settings(LITERAL if text == "literal" else SHIPPED)
            else:
                recipe = recipe._with_setting(name, text)
        return recipe

    def setting_names(self) -> tuple[str, ...]:
        own = tuple(f"{o.key}.{f.name}" for o in self.operations for f in fields(o))
        return (*own, "exposures" if self.hdre is not None else "exposure")

    def _with_setting(self, name: str, text: str) -> Recipe:
        if name not in self.setting_names():
            raise BadInput(
                f"Recipe {self.name} has no setting {_shown(name)}; its settings are {', '.join(self.setting_names())}."
            )
        if name == "exposure":
            return replace(self, exposure="auto" if text.strip() == "auto" else _read_float(name, text))
        if name == "exposures":
            if text.strip() == "all":
                return replace(self, exposures_us=None)
            parts = text.replace(";", ",").replace(" ", ",").split(",")
            return replace(self, exposures_us=tuple(sorted(_read_float(name, t) for t in parts if t)))
        key, _, attribute = name.partition(".")
        operations = tuple(
            replace(o, **{attribute: _READERS[attribute](name, text.strip())}) if o.key == key else o
            for o in self.operations
        )
        return replace(self, operations=operations)

    def to_json(self) -> dict[str, Any]:
        """Everything, as JSON-serialisable data; `from_json` gives the same recipe back."""
        return {
            "format": FORMAT,
            "name": self.name,
            "response": self.response,
            "exposure": self.exposure,
            "exposures_us": None if self.exposures_us is None else list(self.exposures_us),
            "operations": [
                {"operation": o.key, **{f.name: getattr(o, f.name) for f in fields(o)}} for o in self.operations
            ],
        }

    @classmethod
    def from_json(cls, data: Any) -> Recipe:
        """Read what `to_json` wrote (a mapping, or its JSON text)."""
        if isinstance(data, (str, bytes)):
            try:
                data = json.loads(data)
            except ValueError as fault:
                raise BadInput(f"The recipe is not JSON: {fault}.") from fault
        if not isinstance(data, Mapping) or data.get("format") != FORMAT:
            raise BadInput(f'A recipe must be a JSON object with "format": "{FORMAT}".')
        operations: list[Operation] = []
        entries = data.get("operations")
        for entry in entries if isinstance(entries, list) else []:
            values = dict(entry) if isinstance(entry, Mapping) else {}
            kind = _OPERATIONS.get(str(values.pop("operation", None)))
            if kind is None:
                raise BadInput(f"Recipe operation {entry} is unknown; the operations are {', '.join(_OPERATIONS)}.")
            unknown = set(values) - {f.name for f in fields(kind)}
            if unknown:
                raise BadInput(f"Recipe operation {kind.key} has no setting {sorted(unknown)[0]}.")
            try:
                operations.append(kind(**values))
            except TypeError as fault:
                raise BadInput(f"Recipe operation {kind.key} has a setting of the wrong kind: {fault}.") from fault
        _choice("response", data.get("response", "any"), ("any", "linear", "logarithmic"))
        times = data.get("exposures_us")
        return cls(
            name=str(data.get("name")),
            operations=tuple(operations),
            response=data.get("response", "any"),
            exposure=data.get("exposure", "auto"),
            exposures_us=None if times is None else tuple(_number("exposures", t, 0.0, 1e9) for t in times),
        )

    def sha256(self) -> str:
        """Hash of the canonical JSON: equal recipes have equal hashes, whatever machine wrote them."""
        text = json.dumps(_plain_numbers(self.to_json()), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()

    # -- fitting a stack ------------------------------------------------------------------------------------------

    def check_fits(self, header: StackHeader) -> None:
        """Raise `BadInput` when this recipe cannot read such a stack."""
        camera = header.response
        if self.response != "any" and self.response != camera:
            instead = "HDR-CAM, SCI or NF" if camera == "logarithmic" else "PRECISE, NF, SCI, HDRE-I or HDRE-II"
            raise BadInput(
                f"Recipe {self.name} is for a {self.response} camera but the stack is {camera}; use {instead}."
            )
        if self.hdre is not None:
            used = self.exposures_us or header.exposures_us
            missing = [t for t in used if t not in header.exposures_us]
            if missing:
                raise BadInput(
                    f"Recipe {self.name} wants the exposure {missing[0]:g} us but the stack has "
                    f"{', '.join(f'{t:g}' for t in header.exposures_us)} us; choose among these."
                )
            if len(used) < self.hdre.fewest:
                raise BadInput(
                    f"Recipe {self.name} fuses several exposures but the stack has only {used[0]:g} us; "
                    "use NF or SCI, or record a bracket."
                )
            if len(used) > 1 and min(used) <= 0:
                raise BadInput(f"Recipe {self.name} divides by the exposure time, but one is {min(used):g} us.")
        elif self.exposure != "auto" and self.exposure not in header.exposures_us:
            raise BadInput(
                f"Recipe {self.name} wants the exposure {float(self.exposure):g} us but the stack has "
                f"{', '.join(f'{t:g}' for t in header.exposures_us)} us; choose one of these or auto."
            )


def _plain_numbers(value: Any) -> Any:
    """Whole floats as ints, so that 5 and 5.0 hash alike."""
    if isinstance(value, dict):
        return {k: _plain_numbers(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_plain_numbers(v) for v in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _read_float(name: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise BadInput(f"Recipe setting {name} is {_shown(text)}; it must be a number.") from None


def _read_float_or_default(name: str, text: str) -> float | None:
    return None if text in ("default", "none", "auto") else _read_float(name, text)


def _read_int(name: str, text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise BadInput(f"Recipe setting {name} is {_shown(text)}; it must be a whole number.") from None


def _read_text(_name: str, text: str) -> str:
    return text


_READERS: dict[str, Callable[[str, str], Any]] = {
    "mode": _read_text, "window": _read_int, "saturated": _read_text, "p": _read_float,
    "k": _read_float_or_default, "floor": _read_float_or_default, "floor_from": _read_text, "ceiling": _read_float,
    "snr": _read_float_or_default, "grain_px": _read_float_or_default,
    "width_px": _read_float_or_default, "width_factor": _read_float, "gate_px": _read_float,
    "gate_max_px": _read_float, "seed": _read_text, "candidates": _read_text, "continuity": _read_text,
    "jump": _read_float, "fewest": _read_int, "angle_deg": _read_float, "px_per_step": _read_float_or_default,
    "direction": _read_text, "share": _read_float_or_default,
}  # fmt: skip


def _recipe(name: str, *operations: Operation, response: Response = "any") -> Callable[[], Recipe]:
    return lambda: Recipe(name, (*operations, Line(), Centroid()), response=response)


_NAMED: dict[str, Callable[[], Recipe]] = {
    "NF": _recipe("NF"),
    "SCI": _recipe("SCI", Compound()),
    "HDRE-I": _recipe("HDRE-I", Compound(), Exposure(), Tone(), response="linear"),
    "HDRE-II": _recipe("HDRE-II", Exposure(), Tone(), Compound(), response="linear"),
    "HDR-CAM": _recipe("HDR-CAM", Compound(), response="logarithmic"),
    "PRECISE": lambda: Recipe(
        "PRECISE", (Exposure(fewest=1), Compound("sliding"), Line(), Centroid(), Diagonals()), response="linear"
    ),
}
