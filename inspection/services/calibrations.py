"""Adds a calibration to a rig from uploaded gauge pairs. A calibration is never edited: a new one takes over."""

from __future__ import annotations

import datetime as dt
from pathlib import Path
from typing import BinaryIO, Protocol, TextIO

from django.db import transaction
from django.utils import timezone

import scanning.calibration
from inspection.models import Calibration, Rig, User
from inspection.services.audit import audit
from scanning.errors import BadInput

#: Eight gauge steps fit into a few hundred bytes; a megabyte is some other file.
LARGEST_CSV_BYTES = 1_000_000


class NamedFile(Protocol):
    """What an upload and an open file have in common."""

    name: str | None

    def read(self) -> bytes | str: ...


def add_calibration(
    *,
    rig: Rig,
    csv_file: NamedFile | BinaryIO | TextIO | Path | str,
    by: User | None,
    artefact: str,
    done_on: dt.date,
    valid_until: dt.date,
    note: str = "",
) -> Calibration:
    """Fit the gauge pairs in ``csv_file`` (columns height_mm, column_px) and put the line in force for ``rig``.

    ``csv_file`` is an upload, an open file, a path, or the text itself. Raises `BadInput` in one sentence for a file
    that is not such a CSV, NaN, fewer than three pairs, a date that makes no sense, or an unnamed artefact.
    """
    fit = fit_pairs(csv_file, artefact=artefact, done_on=done_on, valid_until=valid_until)
    artefact = artefact.strip()
    if not artefact:
        raise BadInput("Name the gauge and its certificate; a calibration is worth what its gauge is worth.")
    if done_on > timezone.localdate():
        raise BadInput(f"The calibration is dated {done_on:%Y-%m-%d}, in the future; enter the day it was done.")
    if valid_until <= done_on:
        raise BadInput("The calibration must be valid at least one day beyond the day it was done.")
    with transaction.atomic():
        row = Calibration.objects.create(
            rig=rig,
            done_on=done_on,
            valid_until=valid_until,
            by=by,
            artefact=artefact[:200],
            pairs=[list(pair) for pair in zip(fit.heights_mm, fit.columns_px, strict=True)],
            fit=fit.to_json(),
            slope_mm_per_px=fit.slope_mm_per_px,
            intercept_mm=fit.intercept_mm,
            u_slope_mm_per_px=fit.u_slope_mm_per_px,
            max_residual_um=fit.max_residual_um,
            residual_sd_um=fit.residual_sd_um,
            leave_one_out_um=fit.leave_one_out_um,
            low_mm=fit.range_mm[0],
            high_mm=fit.range_mm[1],
            note=note,
        )
        audit(
            by,
            "rig.calibrated",
            rig,
            after={"calibration": row.pk, "slope_mm_per_px": row.slope_mm_per_px, "valid_until": valid_until},
        )
    return row


def fit_pairs(
    csv_file: NamedFile | BinaryIO | TextIO | Path | str,
    *,
    artefact: str = "",
    done_on: dt.date | None = None,
    valid_until: dt.date | None = None,
) -> scanning.calibration.Calibration:
    """Read and fit the pairs without storing anything (the preview of the upload page)."""
    text, where = _read(csv_file)
    heights_mm, columns_px = scanning.calibration.read_pairs(text, where)
    return scanning.calibration.calibrate(
        heights_mm,
        columns_px,
        gauge=artefact.strip(),
        measured_on=done_on.isoformat() if done_on else None,
        expires_on=valid_until.isoformat() if valid_until else None,
        where=where,
    )


def calibration_of(row: Calibration | None) -> scanning.calibration.Calibration | None:
    """Return the working calibration a row holds."""
    return None if row is None else scanning.calibration.Calibration.from_json(row.fit, f"calibration {row.pk}")


def _read(csv_file: NamedFile | BinaryIO | TextIO | Path | str) -> tuple[str, str]:
    if isinstance(csv_file, str):
        return csv_file, "the gauge pairs"
    if isinstance(csv_file, Path):
        try:
            raw: bytes | str = csv_file.read_bytes()
        except OSError as error:
            raise BadInput(f"{csv_file} cannot be read: {error.strerror}.") from error
        where = csv_file.name
    else:
        raw, where = csv_file.read(), Path(str(getattr(csv_file, "name", None) or "the gauge pairs")).name
    if len(raw) > LARGEST_CSV_BYTES:
        raise BadInput(f"{where} is larger than 1 MB; gauge pairs are a handful of lines, so it is another file.")
    if isinstance(raw, str):
        return raw, where
    try:
        return raw.decode("utf-8-sig"), where
    except UnicodeDecodeError:
        raise BadInput(
            f"{where} is not a text file; save the pairs as CSV with columns height_mm and column_px."
        ) from None
