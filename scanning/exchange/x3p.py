"""X3P (ISO 25178-72): the one open exchange format for areal topography, written and read.

Gwyddion, MountainsMap and the instrument makers read it. It counts in metres, and files in the wild break the standard
in known ways: missing points as infinity, checksums that do not match, increments in millimetres. What cannot be read
safely is refused by name; what was read in spite of a fault is written into the provenance.
"""

from __future__ import annotations

import math
import zipfile
import zlib
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import x3pio

import scanning
from scanning.errors import BadInput
from scanning.range_image import RangeImage
from scanning.whole_file import whole_file

UM = 1e-6
LARGEST_BYTES = 2_000_000_000
MOST_MEMBERS = 1000
COARSEST_PITCH_UM = 1000.0
"""A sampling step of over a millimetre in a topography file means that its increments are not metres."""


def write_x3p(
    image: RangeImage, path: Path | str, *, comment: str = "", instrument: str = "", serial: str = ""
) -> None:
    """Write a range image as X3P: heights as 64-bit metres, x along the profiles, y along the rows, NaN = missing.

    The revision is "ISO5436 - 2000", which the most programs accept. ``comment`` should name scan and calibration.
    """
    metadata = x3pio.Metadata(
        date=datetime.now(UTC),
        creator="Edgewatch",
        instrument=x3pio.Instrument("Edgewatch", instrument or "laser line scanner", serial, scanning.__version__),
        calibration_date=_calibrated_on(image.provenance),
        probing_system=x3pio.ProbingSystem(x3pio.ProbingType.NON_CONTACTING, "laser triangulation"),
        comment=comment or None,
    )
    surface = x3pio.Surface.from_array(
        image.height_um.astype(np.float64) * UM,
        x_scale=image.profile_pitch_um * UM,
        y_scale=image.row_pitch_um * UM,
        metadata=metadata,
        revision=x3pio.Revision.ISO5436_2000,
    )
    with whole_file(path) as part:
        part.write_bytes(surface.dumps())


def read_x3p(path: Path | str, *, verify: bool = True) -> RangeImage:
    """Read an X3P surface as a range image; rows along y, profiles along x, heights in um, missing points NaN.

    ``verify=False`` reads a file whose checksums do not match; the provenance then says so. Refused with one sentence:
    what is no X3P, damaged or altered files, profiles and point clouds, several layers, irregular grids, rotations,
    increments that cannot be metres. Only columns, intensity and width are not known (NaN).
    """
    place = Path(path)
    _refuse_unsafe(place)
    try:
        file = x3pio.read(place, verify=verify)
    except x3pio.X3pChecksumError as error:
        raise BadInput(f"{place} was altered after it was written ({error}); get it again from its source") from error
    except (x3pio.X3pError, ValueError, KeyError, OSError, EOFError, zlib.error, zipfile.BadZipFile) as error:
        raise BadInput(f"{place} is not a readable X3P file ({error}); export it again") from error
    if not isinstance(file, x3pio.Surface):
        raise BadInput(f"{place} holds a {file.feature_type.name.lower()}, not a surface; export the areal topography")
    if len(file.layers) != 1:
        raise BadInput(f"{place} holds {len(file.layers)} layers; export a single one")
    if not file.is_regular_grid:
        raise BadInput(f"{place} is not on a regular grid; resample it to even steps and export it again")
    if file.placement.has_rotation:
        raise BadInput(f"{place} is rotated in space; export it in the view's own coordinates")
    layer = file.layers[0]
    profile_pitch_um, row_pitch_um = (step / UM for step in layer.spacing)
    for name, pitch in (("x", profile_pitch_um), ("y", row_pitch_um)):
        if not (math.isfinite(pitch) and 0 < pitch <= COARSEST_PITCH_UM):
            raise BadInput(
                f"{place}: the step along {name} is {pitch * UM:g} m, which is no topography in metres; "
                "correct the unit and export it again"
            )
    # The height of a point is Increment x stored + Offset; the layer leaves the offset out.
    height = layer.z / UM + float(file.placement.offset[2]) / UM
    # Some programs write missing points as infinity.
    height_um = np.where(np.isfinite(height), height, np.nan).astype(np.float32)
    unknown = np.full_like(height_um, np.nan)
    notes = []
    if not verify:
        notes.append("The checksums were not verified.")
    provenance: dict[str, Any] = {"origin": place.name, "format": "X3P", "revision": str(file.revision), "notes": notes}
    if file.metadata is not None:
        provenance["comment"] = file.metadata.comment
        provenance["instrument"] = file.metadata.instrument.model
    return RangeImage(
        column_px=unknown,
        height_um=height_um,
        row_pitch_um=row_pitch_um,
        profile_pitch_um=profile_pitch_um,
        intensity=unknown.copy(),
        width_px=unknown.copy(),
        provenance=provenance,
    )


def _refuse_unsafe(place: Path) -> None:
    """Look into the archive before anything unpacks it: size bombs, paths that lead outside, external entities."""
    try:
        with zipfile.ZipFile(place) as archive:
            members = archive.infolist()
            if len(members) > MOST_MEMBERS or sum(one.file_size for one in members) > LARGEST_BYTES:
                raise BadInput(f"{place} unpacks to more than {LARGEST_BYTES // 10**9} GB or too many files; refused")
            for one in members:
                parts = one.filename.replace("\\", "/").split("/")
                if one.filename.startswith(("/", "\\")) or ".." in parts or ":" in parts[0]:
                    raise BadInput(f"{place} holds the path {one.filename}, which leads outside the archive; refused")
                if one.filename.lower().endswith(".xml") and b"<!" in _without_comments(archive.read(one)):
                    raise BadInput(f"{place}: {one.filename} declares a document type or entities; refused")
    except FileNotFoundError:
        raise BadInput(f"there is no file {place}; check the path") from None
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError, NotImplementedError, ValueError) as error:
        raise BadInput(f"{place} is not a readable X3P file ({error}); export it again") from error


def _without_comments(xml: bytes) -> bytes:
    kept, rest = b"", xml
    while True:
        before, opened, after = rest.partition(b"<!--")
        kept += before
        if not opened:
            return kept
        rest = after.partition(b"-->")[2]


def _calibrated_on(provenance: Mapping[str, Any]) -> datetime | None:
    calibration = provenance.get("calibration")
    measured = calibration.get("measured_on") if isinstance(calibration, dict) else None
    try:
        return datetime.fromisoformat(str(measured)).replace(tzinfo=UTC) if measured else None
    except ValueError:
        return None
